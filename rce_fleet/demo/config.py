"""Configuration of the demo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from rce_fleet.demo.floor import FLOOR, with_surroundings
from rce_fleet.demo.resources import LOOPBACK, Ports
from rce_fleet.demo.worlds import NamedWorld
from rce_fleet.drivers.scene import load_scene, scene_of
from rce_fleet.maps.ros_map import save_map
from rce_fleet.navigation.navigation import DriveLimits
from rce_fleet.planning.lane_files import lane_text
from rce_fleet.planning.lanes import LaneGraph
from rce_fleet.planning.motion import Motion
from rce_fleet.planning.scenario import Scenario
from rce_fleet.wiring import FleetAccount

ROBOT_RADIUS = 0.18
"""Radius of a TurtleBot's hull as the planner knows it, metres."""


JOIN_TOGETHER = 100
"""So many robots join the engine at once, at most."""
PARK_AFTER_PER_ROBOT = 0.4
"""Seconds for each robot of a large fleet before idle ones park. The planner does not know where robots stand
that have not joined yet, so the others must not drive before."""


def motion_on(cell_size: float) -> Motion:
    """Return what turns and stops cost the demo's robots on cells of a size, metres."""
    limits = DriveLimits()
    return Motion.of_robot(
        cell_size=cell_size,
        speed=limits.speed,
        turn_rate=limits.turn_rate,
        acceleration=limits.acceleration,
        turn_acceleration=limits.turn_acceleration,
    )


class Mode(StrEnum):
    """What carries the fleet's messages."""

    CLOUD = "cloud"
    """The engine: planner and move clients in containers, each robot a ROS graph bridged to them."""
    SINGLE = "single"
    """One ROS core for all nodes, robots in namespaces."""
    MULTI = "multi"
    """A ROS core for each robot and one for the planner, which share a few topics."""


class CoreProgram(StrEnum):
    """The program that is the ROS core of the mode ``single``."""

    RCE = "rce"
    """``rce core``."""
    ROSCORE = "roscore"
    """``roscore`` of an installed ROS."""


class MachineBackend(StrEnum):
    """How the machines of the mode ``multi`` are represented."""

    AUTO = "auto"
    """Namespaces if they can be created, else ports."""
    NAMESPACES = "namespaces"
    """A network namespace for each machine, with its own address. Needs root."""
    PORTS = "ports"
    """Ports of the loopback interface."""


class TaskSource(StrEnum):
    """What gives robots something to do while tasks are streamed."""

    MANAGER = "manager"
    """The fleet manager: tasks with two stops are sent to its API."""
    GOALS = "goals"
    """The station: each robot that has reached its goal gets another one."""


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """Configuration of the demo.

    Attributes:
        scenario: Robots, boxes and goals.
        seed: Seed of the sensors' noise.
        ports: Ports; those that the mode needs are chosen.
        folder: Folder for configs, logs and state; must exist.
        runtime: The containers' runtime; the engine's default if empty.
        offload: Localization and navigation run in the robots' containers.
        mode: What carries the fleet's messages.
        core: The program that is the core of the mode ``single``.
        core_uri: A running ROS master to use instead of that program; none if empty.
        machines: How the machines of the mode ``multi`` are represented.
        blocked_cells: Cells that a headless run blocks while robots drive.
        slam: Whether there is no map at the start: the first robot makes it.
        full_stack: So many robots, the first ones, run localization and navigation; the others are light
            ones, which localize and drive by themselves. None: all.
        robots_per_container: How many light robots share a container, a bridge and a ROS graph, at most.
        duration: Seconds for which tasks are streamed; None: one goal for each robot.
        tasks: What is streamed.
        world: What the world has besides cells.
        replicas: How many masters the engine has.
        lanes: What robots drive on; None: on all free cells.
    """

    scenario: Scenario
    seed: int
    ports: Ports
    folder: Path
    runtime: str = ""
    offload: bool = False
    mode: Mode = Mode.CLOUD
    core: CoreProgram = CoreProgram.RCE
    core_uri: str = ""
    machines: MachineBackend = MachineBackend.AUTO
    blocked_cells: int = 1
    slam: bool = False
    full_stack: int | None = None
    robots_per_container: int = 50
    duration: float | None = None
    tasks: TaskSource = TaskSource.MANAGER
    world: NamedWorld | None = None
    replicas: int = 1
    lanes: LaneGraph | None = None

    @property
    def full(self) -> int:
        """Number of robots that run localization and navigation."""
        count = len(self.scenario.robots)
        return count if self.full_stack is None else min(self.full_stack, count)

    @property
    def light_groups(self) -> list[tuple[int, int]]:
        """First and last number of the light robots that share a container; robots count from 1."""
        first, last, share = self.full + 1, len(self.scenario.robots), self.robots_per_container
        return [(start, min(start + share - 1, last)) for start in range(first, last + 1, share)]

    @property
    def account(self) -> FleetAccount:
        """The engine's address and the development user."""
        return FleetAccount(url=",".join(self.master_urls))

    @property
    def master_urls(self) -> tuple[str, ...]:
        """The addresses of all masters."""
        first = self.ports.http
        return tuple(f"http://{LOOPBACK}:{port}/" for port in range(first, first + self.replicas))

    @property
    def scene(self) -> Path:
        """File with the initial state of the simulated world."""
        return self.folder / "scene.json"

    @property
    def map_file(self) -> Path:
        """The map of the walls, for localization and navigation: ``map.yaml``."""
        return self.folder / "map.yaml"

    @property
    def true_map_file(self) -> Path:
        """The map of the true walls and boxes, to compare with."""
        return self.folder / "true_map.yaml"

    @property
    def report(self) -> Path:
        """File that the simulated world writes its reports to."""
        return self.folder / "world.json"

    @property
    def planner_parameters(self) -> dict[str, Any]:
        """The planner's parameters: the map without hidden boxes; without walls if there is no map yet."""
        scenario, grid = self.scenario, self.scenario.grid
        walls = [] if self.slam else sorted(grid.blocked)
        cells = {"walls": walls, "blocked": list(scenario.known_boxes)}
        known = {name: value for name, value in cells.items() if value}
        motion = motion_on(grid.cell_size)
        turns = {"quarter_turn": round(motion.quarter_turn, 2), "stop": round(motion.stop, 2)}
        lanes = {} if self.lanes is None else {"lanes": lane_text(self.lanes)}
        given = {"seed": self.seed, "robot_radius": ROBOT_RADIUS}
        return {**self.map_parameters, **given, **turns, **known, **lanes}

    @property
    def goal_cells(self) -> Sequence[int]:
        """Cells to which robots may be sent; of lanes those from which they can go on."""
        if self.lanes is None:
            return self.scenario.grid.free
        return sorted(self.lanes.connected_part())

    @property
    def chargers(self) -> tuple[int, ...]:
        """Cells with a charger."""
        return () if self.world is None else self.world.chargers

    @property
    def manager_parameters(self) -> dict[str, Any]:
        """The fleet manager's parameters."""
        count = len(self.scenario.robots)
        found: dict[str, Any] = {"chargers": list(self.chargers)} if self.chargers else {}
        if count > JOIN_TOGETHER:
            found["park_after"] = PARK_AFTER_PER_ROBOT * count
        return found

    @property
    def map_parameters(self) -> dict[str, Any]:
        """Parameters for the size of the map and its cells."""
        grid = self.scenario.grid
        return {"rows": grid.rows, "columns": grid.columns, "cell_size": grid.cell_size}

    def write_scene(self) -> None:
        """Write the file that the simulated world reads, and the map of its walls."""
        scene = scene_of(
            self.scenario,
            self.seed,
            full=self.full,
            light_per_graph=self.robots_per_container,
            chargers=self.chargers,
        )
        if self.scenario.grid == FLOOR:
            scene = with_surroundings(scene)
        self.scene.write_text(scene.model_dump_json(indent=1), encoding="utf-8")
        if self.slam:
            save_map(scene.draw(boxes=True), self.true_map_file)
        elif self.full:
            save_map(scene.draw(), self.map_file)

    def write_map(self) -> None:
        """Write the map of the walls if no robot has needed it until now."""
        if not self.map_file.exists():
            save_map(load_scene(self.scene).draw(), self.map_file)
