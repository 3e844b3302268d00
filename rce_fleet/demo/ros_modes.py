"""The modes ``single`` and ``multi``: the fleet on ROS cores, without the engine."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rce.ros.multimaster.addresses import DEFAULT_GROUP
from rce.ros.packages import PackageIndex
from rce_fleet.demo.config import CoreProgram, DemoConfig
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.network import DemoMachine, Network, create_network
from rce_fleet.demo.programs import RCE, START_TIMEOUT, Program, ProgramGroup
from rce_fleet.demo.resources import LOOPBACK
from rce_fleet.demo.traffic import MessageTotals, read_graph_totals

PLANNER = "planner"
"""Name of the planner's machine."""
FROM_ROBOT = ("amcl_pose", "goalNodesList")
"""Topics in each robot's namespace that the planner's machine subscribes to; lists are answered there."""
TO_ROBOT = ("goalNodesList", "cancelGoal")
"""Topics in a robot's namespace that the robot's machine subscribes to at the planner's."""


@dataclass(frozen=True, slots=True)
class RosHost:
    """A host of ROS nodes: this machine, or one that stands for a machine of the fleet.

    Attributes:
        name: Name of the host.
        core_uri: ROS master that its nodes register with.
        prefix: Words before each program's command that run it on this host.
    """

    name: str
    core_uri: str
    prefix: tuple[str, ...] = ()

    async def start(
        self,
        group: ProgramGroup,
        name: str,
        argv: Iterable[str],
        *,
        stop_last: bool = False,
        restartable: bool = False,
    ) -> Program:
        """Start a program on this host, as a node of its graph."""
        return await group.start(
            name, [*self.prefix, *argv], env=self._environment(), stop_last=stop_last, restartable=restartable
        )

    def _environment(self) -> Mapping[str, str]:
        return {"ROS_MASTER_URI": self.core_uri, "ROS_NAMESPACE": ""}


def planner_argv(config: DemoConfig, **more: Any) -> list[str]:
    """Return the command of the planner, with the map and ``more`` as private parameters."""
    return [*_executable("fleet_planner.py"), *_parameters({**config.planner_parameters, **more})]


def move_client_argv(robot: str, **parameters: Any) -> list[str]:
    """Return the command of a robot's move client, with private parameters."""
    return [*_executable("move_client.py"), f"__ns:={robot}", *_parameters(parameters)]


def station_argv(config: DemoConfig, planner_core: str) -> list[str]:
    """Return the command of the operator station, in the planner's graph."""
    station = [sys.executable, "-m", "rce_fleet.station"]
    return [*station, "--ros-master", planner_core, "--port", str(config.ports.page)]


def world_argv(config: DemoConfig, planner_core: str, cores: Mapping[str, str]) -> list[str]:
    """Return the command of the simulated world; its robots join the graphs of ``cores`` (robot to URI)."""
    program = [sys.executable, "-m", "rce_fleet.drivers", str(config.scene), "--report", str(config.report)]
    joins = [part for robot, uri in cores.items() for part in ("--core", f"{robot}={uri}")]
    return [*program, "--planner-core", planner_core, *joins]


def node_names(config: DemoConfig) -> frozenset[str]:
    """Return the global names of the demo's nodes; a graph may have others."""
    robots = [f"/{robot}/{node}" for robot in config.scenario.robots for node in ("robot", "move_client")]
    return frozenset((*robots, "/fleet_planner", "/operator_station", "/world"))


def _parameters(values: Mapping[str, Any]) -> Iterable[str]:
    return (f"_{name}:={json.dumps(value)}" for name, value in values.items())


def _executable(exe: str) -> list[str]:
    return PackageIndex.from_environ().find("fleet").executable(exe)


class SingleCorePrograms:
    """One ROS core: planner, move clients and robots are nodes of one graph, the robots' in namespaces."""

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._uri = config.core_uri or f"http://{LOOPBACK}:{config.ports.core}/"

    async def start(self, group: ProgramGroup) -> str:
        """Start all programs; return the URL of the page."""
        config, uri = self._config, self._uri
        config.write_scene()
        if not config.core_uri:
            await self._start_core(group)
        host = RosHost("here", uri)
        robots = config.scenario.robots
        world = await host.start(group, "world", world_argv(config, uri, dict.fromkeys(robots, uri)))
        await host.start(group, "planner", planner_argv(config), restartable=True)
        station = await host.start(group, "station", station_argv(config, uri), restartable=True)
        for number, robot in enumerate(robots, start=1):
            await host.start(group, f"move_client{number}", move_client_argv(robot), restartable=True)
        page = await group.wait_line(station, "rce ui ready:", START_TIMEOUT)
        await group.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def read_totals(self) -> MessageTotals:
        """Read the message totals of all nodes."""
        return await read_graph_totals([self._uri], node_names(self._config))

    async def _start_core(self, group: ProgramGroup) -> None:
        config, port = self._config, str(self._config.ports.core)
        home = config.folder / "ros"
        env = {"ROS_HOME": str(home), "ROS_LOG_DIR": str(home / "log"), "ROS_IP": LOOPBACK}
        if config.core is CoreProgram.RCE:
            core = await group.start("core", [*RCE, "core", "--port", port], env=env, stop_last=True)
            await group.wait_line(core, "rce core ready:", START_TIMEOUT)
            return
        program = shutil.which("roscore")
        if program is None:
            raise DemoError(
                "the program roscore was not found; install it (Debian: ros-core) or use --core rce"
            )
        core = await group.start("core", [program, "-p", port], env=env, stop_last=True)
        await group.wait_line(core, "started core service [/rosout]", START_TIMEOUT)


class MultiCorePrograms:
    """A ROS core per machine: one for the planner, one for each robot, which share a few topics.

    Each robot's machine runs its core and move client; discovery and sync run on every machine. The
    simulated world has no core: it stands for the robots' hardware, and its nodes join the robots' cores.
    """

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._cores: list[str] = []

    async def start(self, group: ProgramGroup) -> str:
        """Start all programs; return the URL of the page."""
        config, robots = self._config, self._config.scenario.robots
        config.write_scene()
        network = await create_network(config.machines, [PLANNER, *robots], group)
        self._cores = [machine.core_uri for machine in network.machines]
        await _start_cores(network, group)
        planner, *others = network.machines
        uris = {machine.name: machine.core_uri for machine in others}
        here = RosHost("here", planner.core_uri)
        world_host = RosHost("world", planner.core_uri, prefix=network.world_prefix)
        world = await world_host.start(group, "world", world_argv(config, planner.core_uri, uris))
        station = await here.start(group, "station", station_argv(config, planner.core_uri), restartable=True)
        argv = planner_argv(config, answers=True)
        await _host_of(planner).start(group, "planner", argv, restartable=True)
        for number, machine in enumerate(others, start=1):
            argv = move_client_argv(machine.name, answers=True, **config.map_parameters)
            await _host_of(machine).start(group, f"move_client{number}", argv, restartable=True)
        await _join_machines(network, robots, group)
        page = await group.wait_line(station, "rce ui ready:", START_TIMEOUT)
        await group.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def read_totals(self) -> MessageTotals:
        """Read the message totals of all nodes."""
        return await read_graph_totals(self._cores, node_names(self._config))


def sync_argv(machine: str, robots: Iterable[str]) -> list[str]:
    """Return the command of a machine's sync: the topics, and the machines that it takes them from."""
    if machine == PLANNER:
        # The node of a robot's hardware runs on another machine, with the world.
        topics = [f"/{robot}/{name}" for robot in robots for name in FROM_ROBOT]
        return [*_command("sync"), "--topics", ",".join(topics), "--sync-remote-nodes"]
    topics = [f"/{machine}/{name}" for name in TO_ROBOT]
    return [*_command("sync"), "--topics", ",".join(topics), "--hosts", PLANNER]


def discovery_argv(machine: DemoMachine, network: Network) -> list[str]:
    """Return the command of a machine's discovery."""
    options = {
        "--name": machine.name,
        "--mcast-group": f"{DEFAULT_GROUP}@{machine.address}",
        "--mcast-port": network.multicast_port,
        "--rpc-addr": machine.address,
        "--rpc-port": machine.rpc_port,
    }
    return [*_command("discovery"), *(str(part) for item in options.items() for part in item)]


def _command(name: str) -> list[str]:
    """Return a command line for one command of ``rce``; it starts faster than all of them."""
    return [sys.executable, "-c", f"import typer; from rce.cli.{name} import {name}; typer.run({name})"]


def _host_of(machine: DemoMachine) -> RosHost:
    return RosHost(machine.name, machine.core_uri, machine.prefix)


async def _start_cores(network: Network, group: ProgramGroup) -> None:
    cores: list[Program] = []
    for machine in network.machines:
        argv = [*RCE, "core", "--port", str(machine.core_port), "--bind", machine.address, "--no-log"]
        cores.append(await _host_of(machine).start(group, f"core-{machine.name}", argv, stop_last=True))
    for core in cores:
        await group.wait_line(core, "rce core ready:", START_TIMEOUT)


async def _join_machines(network: Network, robots: Iterable[str], group: ProgramGroup) -> None:
    """Start discovery and sync on every machine."""
    discoveries = [
        await _host_of(machine).start(
            group, f"discovery-{machine.name}", discovery_argv(machine, network), restartable=True
        )
        for machine in network.machines
    ]
    for machine, discovery in zip(network.machines, discoveries, strict=True):
        await group.wait_line(discovery, "rce discovery ready:", START_TIMEOUT)
        await _host_of(machine).start(
            group, f"sync-{machine.name}", sync_argv(machine.name, robots), restartable=True
        )
