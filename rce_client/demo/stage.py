"""Sets the stage: engine, operator station, world and one bridge for each robot, as separate processes."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rce.fleet.scenario import Scenario
from rce_client.demo.children import Children, Program
from rce_client.demo.ports import LOOPBACK, Ports
from rce_client.fleet_config import Account, as_text, fleet_config, robot_config
from rce_client.simulation.report import WorldReport, read_report
from rce_client.simulation.scene import scene_of

START_TIMEOUT = 90.0
"""Seconds for one program to come up, on a machine that starts many at once."""
_RCE = ("-c", "from rce.cli import main; main()")


@dataclass(frozen=True, slots=True)
class Play:
    """What is to be played, and where.

    Attributes:
        scenario: Robots, boxes and goals.
        seed: Of the errors of the robots' senses.
        ports: All chosen.
        folder: For configs, logs and state; must exist.
        runtime: How containers are kept apart; the engine's choice if empty.
    """

    scenario: Scenario
    seed: int
    ports: Ports
    folder: Path
    runtime: str = ""

    @property
    def account(self) -> Account:
        """The engine's address and the development user."""
        return Account(url=f"http://{LOOPBACK}:{self.ports.http}/")

    @property
    def report(self) -> Path:
        """Where the world says what truly happened."""
        return self.folder / "world.json"


@dataclass(frozen=True, slots=True)
class Stage:
    """Everything runs.

    Attributes:
        page: URL of the operator's page.
        play: What is played.
        children: The programs.
    """

    page: str
    play: Play
    children: Children

    def truth(self) -> WorldReport | None:
        """What truly happened in the world until a moment ago."""
        return read_report(self.play.report)


@asynccontextmanager
async def set_stage(play: Play, show: Callable[[str], None]) -> AsyncIterator[Stage]:
    """Start all programs, and end them all when the block is left.

    Args:
        play: What is to be played.
        show: Gets every line that a program prints.

    Raises:
        ChildDiedError: A program ended at its start.
        NotReadyError: A program did not come up.
        OSError: A program cannot be started, or a file not written.
    """
    _write_files(play)
    async with Children(play.folder, show) as children:
        page = await children.while_alive(_start(play, children))
        yield Stage(page, play, children)


def planner_parameters(scenario: Scenario, seed: int) -> dict[str, Any]:
    """What the planner is told of the floor. It is not told of hidden boxes."""
    grid = scenario.grid
    parameters: dict[str, Any] = {
        "rows": grid.rows,
        "columns": grid.columns,
        "cell_size": grid.cell_size,
        "seed": seed,
    }
    cells = {"walls": sorted(grid.blocked), "blocked": list(scenario.known_boxes)}
    return {**parameters, **{name: value for name, value in cells.items() if value}}


def _write_files(play: Play) -> None:
    folder, account = play.folder, play.account
    scene = scene_of(play.scenario, play.seed)
    (folder / "scene.json").write_text(scene.model_dump_json(indent=1), encoding="utf-8")
    parameters = planner_parameters(play.scenario, play.seed)
    (folder / "fleet.config").write_text(as_text(fleet_config(account, parameters)), encoding="utf-8")
    for number in range(1, len(play.scenario.robots) + 1):
        text = as_text(robot_config(number, account))
        (folder / f"robot{number}.config").write_text(text, encoding="utf-8")


async def _start(play: Play, children: Children) -> str:
    """Start everything; returns the URL of the page."""
    engine = await children.start("engine", _engine_argv(play))
    world = await children.start("world", _world_argv(play))
    await children.wait_line(engine, "RCE ready:", START_TIMEOUT)
    station = await children.start("station", _station_argv(play))
    uris = await _graphs_of(play, children, world)
    page = await children.wait_line(station, "rce ui ready:", START_TIMEOUT)
    bridges = [
        await children.start(
            f"robot{number}",
            [sys.executable, "-m", "rce_client.ros_bridge", str(play.folder / f"robot{number}.config")],
            env={"ROS_MASTER_URI": uris[robot]},
        )
        for number, robot in enumerate(play.scenario.robots, start=1)
    ]
    for bridge in bridges:
        await children.wait_line(bridge, "rce-ros ready:", START_TIMEOUT)
    await children.wait_line(world, "simulation ready:", START_TIMEOUT)
    return page


async def _graphs_of(play: Play, children: Children, world: Program) -> dict[str, str]:
    """The ROS master of each robot, as the world says them."""
    return {
        robot: await children.wait_line(world, f"robot {robot} ROS_MASTER_URI=", START_TIMEOUT)
        for robot in play.scenario.robots
    }


def _engine_argv(play: Play) -> list[str]:
    ports = play.ports
    options = {
        "--state-dir": play.folder / "engine",
        "--http-port": ports.http,
        "--control-port": ports.control,
        "--ws-port": ports.ws,
        "--robot-link-port": ports.robot_link,
        "--container-link-port": ports.container_link,
        **({"--runtime": play.runtime} if play.runtime else {}),
    }
    return [sys.executable, *_RCE, "up", "--dev", *(str(part) for item in options.items() for part in item)]


def _station_argv(play: Play) -> list[str]:
    config = str(play.folder / "fleet.config")
    return [sys.executable, "-m", "rce_client.station", config, "--port", str(play.ports.page)]


def _world_argv(play: Play) -> list[str]:
    program = [sys.executable, "-m", "rce_client.simulation", str(play.folder / "scene.json")]
    account = play.account
    return [*program, "--report", str(play.report), "--master", account.url, "--user", account.user]
