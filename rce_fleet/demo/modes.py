"""The demo's modes: starts the programs of one of them, and stops them together."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import aiohttp

from rce.config.documents import write_items
from rce_fleet.demo.config import JOIN_TOGETHER, DemoConfig, Mode
from rce_fleet.demo.newcomers import Newcomers
from rce_fleet.demo.programs import RCE, START_TIMEOUT, Program, ProgramGroup
from rce_fleet.demo.robots import (
    RobotGraph,
    client_config,
    cloud_arguments,
    dock_of,
    start_robot,
    start_robots,
)
from rce_fleet.demo.ros_modes import MultiCorePrograms, SingleCorePrograms
from rce_fleet.demo.traffic import MessageTotals, read_engine_totals
from rce_fleet.drivers.report import WorldReport, read_report
from rce_fleet.station.client import StationClient
from rce_fleet.wiring import fleet_config, light_config

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.demo.exploration import Explored
    from rce_fleet.geometry.poses import Pose

_GRAPH_LINE = "robot {} ROS_MASTER_URI="
"""Beginning of the line in which the world tells where a robot's graph is."""
START_PER_ROBOT = 0.5
"""Seconds that the start may take longer for each robot: each has some ten connections in the engine."""


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
        self._world: Program | None = None

    async def start(self, group: ProgramGroup) -> str:
        """Start all programs; return the URL of the page."""
        config = self._config
        self._write_files()
        engine = await group.start("engine", self._engine_argv(), stop_last=True)
        world = self._world = await group.start("world", self._world_argv())
        await group.wait_line(engine, "RCE ready:", START_TIMEOUT)
        self._graphs = await self._find_graphs(group, world)
        light = await self._find_light_graphs(group, world)
        truth = await group.wait_line(world, "world ROS_MASTER_URI=", START_TIMEOUT)
        station = await group.start("station", self._station_argv(truth), restartable=True)
        page = await group.wait_line(station, "rce ui ready:", START_TIMEOUT)
        if not config.slam:
            await start_robots(group, config, self)
        await self._start_bridges(group, light)
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

    @asynccontextmanager
    async def joined(self, group: ProgramGroup, number: int, at: Pose) -> AsyncIterator[None]:
        """Make a robot that was put into the world one of the fleet, until the block is left.

        Args:
            group: Gets the robot's programs, and loses them at the end.
            number: Of the robot: ``Robot4`` has 4.
            at: Where it stands.

        Raises:
            DemoError: Its programs were not ready in time.
            OSError: A program cannot be started, or a file cannot be written.
        """
        assert self._world is not None, "robots are put into a world that runs"
        config, robot, name = self._config, f"Robot{number}", f"robot{number}"
        await asyncio.to_thread(config.write_map)
        self._write_config(name, client_config(config, number, at))
        uri = await group.wait_line(self._world, _GRAPH_LINE.format(robot), START_TIMEOUT)
        graph = RobotGraph(robot, uri, offloaded=config.offload)
        async with AsyncExitStack() as stack:
            nodes = await start_robot(group, config, graph, at, self.launch_arguments(graph))
            stack.push_async_callback(group.end, nodes)
            bridge = await self._start_bridge(group, name, uri)
            stack.push_async_callback(group.end, bridge)
            await _wait_ready(group, [bridge], 1)
            yield

    async def _start_bridge(self, group: ProgramGroup, name: str, uri: str) -> Program:
        argv = [sys.executable, "-m", "rce_client.ros_bridge", str(self._config_file(name))]
        return await group.start(name, argv, env={"ROS_MASTER_URI": uri}, restartable=True)

    def _config_file(self, name: str) -> Path:
        return self._config.folder / f"{name}.config"

    def _write_config(self, name: str, content: Mapping[str, Any]) -> None:
        self._config_file(name).write_text(write_items(content), encoding="utf-8")

    async def _start_bridges(self, group: ProgramGroup, light: Mapping[str, str]) -> None:
        """Connect all robots, the next ones when those before are ready: the master answers in time then.

        Args:
            group: Gets the programs.
            light: ROS masters of the graphs that light robots share, by the name of their bridge.
        """
        config = self._config
        bridges = [(f"robot{number}", graph.uri, 1) for number, graph in enumerate(self._graphs, start=1)]
        bridges += [
            (name, uri, last - first + 1)
            for (name, uri), (first, last) in zip(light.items(), config.light_groups, strict=True)
        ]
        joining: list[Program] = []
        robots = 0
        for name, uri, count in bridges:
            if robots + count > JOIN_TOGETHER:
                await _wait_ready(group, joining, robots)
                joining, robots = [], 0
            joining.append(await self._start_bridge(group, name, uri))
            robots += count
        await _wait_ready(group, joining, robots)

    def _write_files(self) -> None:
        config, account = self._config, self._config.account
        config.write_scene()
        robots = len(config.scenario.robots)
        fleet = fleet_config(account, config.planner_parameters, config.manager_parameters, robots=robots)
        self._write_config("fleet", fleet)
        for number, robot in enumerate(config.scenario.robots[: config.full], start=1):
            self._write_config(f"robot{number}", client_config(config, number, dock_of(config, robot)))
        for ends in config.light_groups:
            self._write_config(_light_name(*ends), light_config(*ends, account))

    async def _find_graphs(self, group: ProgramGroup, world: Program) -> list[RobotGraph]:
        """Return each robot's graph, as the world prints it."""
        return [
            RobotGraph(
                robot,
                await group.wait_line(world, _GRAPH_LINE.format(robot), START_TIMEOUT),
                offloaded=self._config.offload,
            )
            for robot in self._config.scenario.robots[: self._config.full]
        ]

    async def _find_light_graphs(self, group: ProgramGroup, world: Program) -> dict[str, str]:
        """Return the ROS masters of the graphs that light robots share, by the name of their bridge."""
        found = {}
        for first, last in self._config.light_groups:
            line = f"robots Robot{first} to Robot{last} ROS_MASTER_URI="
            found[_light_name(first, last)] = await group.wait_line(world, line, START_TIMEOUT)
        return found

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
            **({"--replicas": config.replicas} if config.replicas > 1 else {}),
        }
        words = [str(part) for item in options.items() for part in item]
        return [*RCE, "up", "--dev", "--no-offer-images", *words]

    def _station_argv(self, world: str) -> list[str]:
        folder, page = self._config.folder, str(self._config.ports.page)
        options = ["--port", page, "--world", world, "--state-dir", str(folder / "station")]
        demo = ["--demo"] if self._config.replicas > 1 else []
        return [sys.executable, "-m", "rce_fleet.station", str(folder / "fleet.config"), *options, *demo]

    def _world_argv(self) -> list[str]:
        config, account = self._config, self._config.account
        program = [sys.executable, "-m", "rce_fleet.drivers", str(config.scene), "--services"]
        return [*program, "--report", str(config.report), "--master", account.url, "--user", account.user]


async def _wait_ready(group: ProgramGroup, bridges: Sequence[Program], robots: int) -> None:
    for bridge in bridges:
        await group.wait_line(bridge, "rce-ros ready:", START_TIMEOUT + START_PER_ROBOT * robots)


def _light_name(first: int, last: int) -> str:
    """Return the name of the bridge of light robots."""
    return f"robots{first}-{last}"


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

    async def keep_newcomers(self, say: Callable[[str], None]) -> None:
        """Make robots that are put into the world robots of the fleet, until cancelled.

        Only the engine takes them: the graphs of the other modes are made for the first robots.
        """
        if isinstance(self.mode, CloudPrograms):
            first = frozenset(self.config.scenario.robots)
            await Newcomers(first, self.truth, partial(self.mode.joined, self.group), say).run()

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
            (first, *_) = mode.graphs()
            say(f"there is no map yet; see it grow at {page}#robot={first.robot}&layers=map,scan")
            explored = await group.run_while_alive(_explore(config, group, mode, page, say))
        yield RunningDemo(page, config, group, mode, explored)


async def _explore(
    config: DemoConfig, group: ProgramGroup, mode: ModePrograms, page: str, say: Callable[[str], None]
) -> Explored:
    """Let the first robot make the map, and start all robots on it."""
    from rce_fleet.demo.exploration import block_cells, explore  # long to load, needed only without a map

    first, *_ = mode.graphs()
    explored = await explore(group, config, first, mode.launch_arguments(first), say)
    async with aiohttp.ClientSession() as session:
        await block_cells(StationClient(session, page), explored.blocked, say)
    await start_robots(group, config, mode, {first.robot: explored.initial_pose})
    return explored
