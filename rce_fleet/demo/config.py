"""What the demo runs, and where."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from rce_fleet.demo.ports import LOOPBACK, Ports
from rce_fleet.drivers.scene import scene_of
from rce_fleet.planning.scenario import Scenario
from rce_fleet.wiring import Account


class Mode(StrEnum):
    """What carries the fleet's messages."""

    CLOUD = "cloud"
    """The engine: planner and move clients in containers, each robot a ROS graph that is bridged to them."""
    SINGLE = "single"
    """One ROS core for everybody, robots in namespaces."""
    MULTI = "multi"
    """A ROS core for each robot and one for the planner, which share a few topics."""


class CoreKind(StrEnum):
    """Which program is the ROS core of the mode ``single``."""

    RCE = "rce"
    """``rce core``."""
    ROSCORE = "roscore"
    """The one of an installed ROS."""


class Machines(StrEnum):
    """What stands for the machines of the mode ``multi``."""

    AUTO = "auto"
    """Namespaces where they can be made, else ports."""
    NAMESPACES = "namespaces"
    """A network namespace for each machine, with an address of its own. Only root can make them."""
    PORTS = "ports"
    """Ports of the loopback interface."""


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """What the demo runs, and where.

    Attributes:
        scenario: Robots, boxes and goals.
        seed: Of the errors of the robots' senses.
        ports: All that the mode needs are chosen.
        folder: For configs, logs and state; must exist.
        runtime: How containers are kept apart; the engine's choice if empty.
        mode: What carries the fleet's messages.
        core: Which program is the core of the mode ``single``.
        core_uri: A ROS master that runs already and takes that program's place; none if empty.
        machines: What stands for the machines of the mode ``multi``.
        blocked_cells: How many cells a headless run blocks while robots drive.
    """

    scenario: Scenario
    seed: int
    ports: Ports
    folder: Path
    runtime: str = ""
    mode: Mode = Mode.CLOUD
    core: CoreKind = CoreKind.RCE
    core_uri: str = ""
    machines: Machines = Machines.AUTO
    blocked_cells: int = 1

    @property
    def account(self) -> Account:
        """The engine's address and the development user."""
        return Account(url=f"http://{LOOPBACK}:{self.ports.http}/")

    @property
    def scene(self) -> Path:
        """What stands where at the beginning."""
        return self.folder / "scene.json"

    @property
    def report(self) -> Path:
        """Where the world says what truly happened."""
        return self.folder / "world.json"

    @property
    def planner_parameters(self) -> dict[str, Any]:
        """What the planner is told of the floor. It is not told of hidden boxes."""
        scenario, grid = self.scenario, self.scenario.grid
        cells = {"walls": sorted(grid.blocked), "blocked": list(scenario.known_boxes)}
        known = {name: value for name, value in cells.items() if value}
        return {**self.map_parameters, "seed": self.seed, **known}

    @property
    def map_parameters(self) -> dict[str, Any]:
        """Size and cells of the map."""
        grid = self.scenario.grid
        return {"rows": grid.rows, "columns": grid.columns, "cell_size": grid.cell_size}

    def write_scene(self) -> None:
        """Write the file that the world reads."""
        scene = scene_of(self.scenario, self.seed)
        self.scene.write_text(scene.model_dump_json(indent=1), encoding="utf-8")
