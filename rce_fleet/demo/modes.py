"""The demo's modes: starts the programs of one of them, and stops them together."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Protocol

import aiohttp

from rce.config.documents import write_items
from rce_fleet.demo.config import DemoConfig, Mode
from rce_fleet.demo.exploration import Explored, block_cells, explore
from rce_fleet.demo.programs import RCE, START_TIMEOUT, Program, ProgramGroup
from rce_fleet.demo.robots import RobotGraph, client_config, cloud_arguments, start_robots
from rce_fleet.demo.ros_modes import MultiCorePrograms, SingleCorePrograms
from rce_fleet.demo.traffic import MessageTotals, read_engine_totals
from rce_fleet.drivers.report import WorldReport, read_report
from rce_fleet.station.client import StationClient
from rce_fleet.wiring import fleet_config


class ModePrograms(Protocol):
    """The programs of one mode."""

    async def start(self, group: ProgramGroup) -> str:
        """Write the files and start all programs; return the URL of the page.

        Without a map (``slam``), the nodes of the robots are left out.

        Raises:
            DemoError: A program ended, or was not ready in time.
            OSError: A program cannot be started, or a file cannot be written.
        """

    def graphs(self) -> Sequence[RobotGraph]:
        """Return where the nodes of each robot are, once all programs are started."""

    def launch_arguments(self, graph: RobotGraph) -> Mapping[str, object]:
        """Return the arguments of the launch file of a robot's nodes."""

    async def read_totals(self) -> MessageTotals:
        """Return how many messages were received until now.

        Raises:
            DemoError: The counters cannot be read.
        """


class CloudPrograms:
    """The engine: planner and move clients run in containers, ``rce-ros`` bridges the robots.

    Localization and navigation run on the robots, or off-loaded in their containers.
    """

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._graphs: list[RobotGraph] = []

    async def start(self, group: ProgramGroup) -> str:
        """Start all programs; return the URL of the page."""
        config = self._config
        self._write_files()
        engine = await group.start("engine", self._engine_argv(), stop_last=True)
        world = await group.start("world", self._world_argv())
        await group.wait_line(engine, "RCE ready:", START_TIMEOUT)
        station = await group.start("station", self._station_argv(), restartable=True)
        self._graphs = await self._find_graphs(group, world)
        page = await group.wait_line(station, "rce ui ready:", START_TIMEOUT)
        if not config.slam:
            await start_robots(group, config, self)
        bridges = [
            await group.start(
                f"robot{number}",
                [sys.executable, "-m", "rce_client.ros_bridge", str(config.folder / f"robot{number}.config")],
                env={"ROS_MASTER_URI": graph.uri},
                restartable=True,
            )
            for number, graph in enumerate(self._graphs, start=1)
        ]
        for bridge in bridges:
            await group.wait_line(bridge, "rce-ros ready:", START_TIMEOUT)
        await group.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    def graphs(self) -> Sequence[RobotGraph]:
        """Return where the nodes of each robot are."""
        return self._graphs

    def launch_arguments(self, graph: RobotGraph) -> Mapping[str, object]:
        """Return the arguments of the launch file of a robot's nodes."""
        return cloud_arguments(self._config, graph.robot)

    async def read_totals(self) -> MessageTotals:
        """Read the message totals from the master."""
        account = self._config.account
        return await read_engine_totals(account.url, account.user, account.password)

    def _write_files(self) -> None:
        config, account, folder = self._config, self._config.account, self._config.folder
        config.write_scene()
        fleet = fleet_config(account, config.planner_parameters)
        (folder / "fleet.config").write_text(write_items(fleet), encoding="utf-8")
        for number in range(1, len(config.scenario.robots) + 1):
            text = write_items(client_config(config, number))
            (folder / f"robot{number}.config").write_text(text, encoding="utf-8")

    async def _find_graphs(self, group: ProgramGroup, world: Program) -> list[RobotGraph]:
        """Return each robot's graph, as the world prints it."""
        return [
            RobotGraph(
                robot,
                await group.wait_line(world, f"robot {robot} ROS_MASTER_URI=", START_TIMEOUT),
                offloaded=self._config.offload,
            )
            for robot in self._config.scenario.robots
        ]

    def _engine_argv(self) -> list[str]:
        config, ports = self._config, self._config.ports
        options = {
            "--state-dir": config.folder / "engine",
            "--http-port": ports.http,
            "--control-port": ports.control,
            "--ws-port": ports.ws,
            "--robot-link-port": ports.robot_link,
            "--container-link-port": ports.container_link,
            **({"--runtime": config.runtime} if config.runtime else {}),
        }
        return [*RCE, "up", "--dev", *(str(part) for item in options.items() for part in item)]

    def _station_argv(self) -> list[str]:
        config = str(self._config.folder / "fleet.config")
        return [sys.executable, "-m", "rce_fleet.station", config, "--port", str(self._config.ports.page)]

    def _world_argv(self) -> list[str]:
        config, account = self._config, self._config.account
        program = [sys.executable, "-m", "rce_fleet.drivers", str(config.scene)]
        return [*program, "--report", str(config.report), "--master", account.url, "--user", account.user]


_PROGRAMS: dict[Mode, Callable[[DemoConfig], ModePrograms]] = {
    Mode.CLOUD: CloudPrograms,
    Mode.SINGLE: SingleCorePrograms,
    Mode.MULTI: MultiCorePrograms,
}


@dataclass(frozen=True, slots=True)
class RunningDemo:
    """A demo whose programs run.

    Attributes:
        page: URL of the operator's page.
        config: What it runs.
        group: All programs.
        mode: The programs of the mode.
        explored: What the first robot explored; None if there was a map.
    """

    page: str
    config: DemoConfig
    group: ProgramGroup
    mode: ModePrograms
    explored: Explored | None = None

    def truth(self) -> WorldReport | None:
        """Return the newest report of the simulated world; None before the first."""
        return read_report(self.config.report)


@asynccontextmanager
async def start_demo(
    config: DemoConfig, show: Callable[[str], None], say: Callable[[str], None]
) -> AsyncIterator[RunningDemo]:
    """Start all programs; stop them when the block is left.

    Args:
        config: What to run.
        show: Called with every line that a program prints.
        say: Prints a line for the user.

    Raises:
        DemoError: A program ended, or was not ready in time.
        OSError: A program cannot be started, or a file cannot be written.
    """
    mode = _PROGRAMS[config.mode](config)
    async with ProgramGroup(config.folder, show) as group:
        page = await group.run_while_alive(mode.start(group))
        explored = None
        if config.slam:
            say(f"there is no map yet; see it grow at {page}")
            explored = await group.run_while_alive(_explore(config, group, mode, page, say))
        yield RunningDemo(page, config, group, mode, explored)


async def _explore(
    config: DemoConfig, group: ProgramGroup, mode: ModePrograms, page: str, say: Callable[[str], None]
) -> Explored:
    """Let the first robot make the map, and start all robots on it."""
    first, *_ = mode.graphs()
    explored = await explore(group, config, first, mode.launch_arguments(first), say)
    async with aiohttp.ClientSession() as session:
        await block_cells(StationClient(session, page), explored.blocked, say)
    await start_robots(group, config, mode, {first.robot: explored.initial_pose})
    return explored
