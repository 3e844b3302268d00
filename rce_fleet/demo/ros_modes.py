"""The modes ``single`` and ``multi``: the fleet on ROS cores, without the engine."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rce.ros.multimaster.addresses import DEFAULT_GROUP
from rce.ros.packages import PackageIndex
from rce_fleet.demo.config import CoreProgram, DemoConfig
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.network import DemoMachine, Network, create_network
from rce_fleet.demo.programs import RCE, START_TIMEOUT, Program, ProgramGroup, rce_command
from rce_fleet.demo.resources import LOOPBACK
from rce_fleet.demo.robots import RobotGraph, start_robots
from rce_fleet.demo.traffic import MessageTotals, read_graph_totals

PLANNER = "planner"
"""Name of the planner's machine."""
FROM_ROBOT = ("amcl_pose", "goalNodesList")
"""Topics in each robot's namespace that the planner's machine subscribes to; lists are answered there."""
TO_ROBOT = ("goalNodesList", "cancelGoal")
"""Topics in a robot's namespace that the robot's machine subscribes to at the planner's."""
TO_ALL = ("/fleet/map", "/fleet/state")
"""Topics of the planner that each robot's machine subscribes to: what obstacles are compared with."""
MOVE_BASE = ("goal", "cancel", "status", "result", "feedback")
CELLS = ("blockedCells", "freedCells")


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


def move_client_argv(robot: str, *, namespace: bool = True, **parameters: Any) -> list[str]:
    """Return the command of a robot's move client.

    Args:
        robot: The robot.
        namespace: Whether the robot's other nodes are in its namespace.
        parameters: Private parameters.
    """
    names = () if namespace else (*(f"move_base/{name}" for name in MOVE_BASE), *CELLS)
    remappings = (f"{name}:=/{name}" for name in names)
    return [*_executable("move_client.py"), f"__ns:={robot}", *remappings, *_parameters(parameters)]


def station_argv(config: DemoConfig, planner_core: str, world: str = "") -> list[str]:
    """Return the command of the operator station, in the planner's graph.

    Args:
        config: What the demo runs.
        planner_core: URI of the planner's master.
        world: URI of the master with the world's services; empty: the station does not reach it.
    """
    station = [sys.executable, "-m", "rce_fleet.station"]
    options = ["--port", str(config.ports.page), "--state-dir", str(config.folder / "station")]
    return [*station, "--ros-master", planner_core, *options, *(["--world", world] if world else [])]


def world_argv(
    config: DemoConfig, planner_core: str, cores: Mapping[str, str], *, namespaces: bool = True
) -> list[str]:
    """Return the command of the simulated world.

    Args:
        config: What the demo runs.
        planner_core: URI of the planner's master.
        cores: URI of each robot's master.
        namespaces: Whether robots have namespaces there.
    """
    program = [sys.executable, "-m", "rce_fleet.drivers", str(config.scene), "--report", str(config.report)]
    joins = [part for robot, uri in cores.items() for part in ("--core", f"{robot}={uri}")]
    return [*program, "--planner-core", planner_core, *joins, *([] if namespaces else ["--no-namespaces"])]


ROBOT_NODES = ("robot", "amcl", "move_base", "velocity_limiter", "obstacle_cells")


def node_names(graphs: Iterable[RobotGraph]) -> frozenset[str]:
    """Return the global names of the demo's nodes; a graph may have others."""
    robots = {graph.topic(node) for graph in graphs for node in ROBOT_NODES}
    clients = {f"/{graph.robot}/move_client" for graph in graphs}
    return frozenset((*robots, *clients, "/map_server", "/fleet_planner", "/operator_station", "/world"))


def _parameters(values: Mapping[str, Any]) -> Iterable[str]:
    return (f"_{name}:={json.dumps(value)}" for name, value in values.items())


def _executable(exe: str) -> list[str]:
    return PackageIndex.from_environ().find("fleet").executable(exe)


class SingleCorePrograms:
    """One ROS core: planner, move clients and robots are nodes of one graph, the robots' in namespaces."""

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._uri = config.core_uri or f"http://{LOOPBACK}:{config.ports.core}/"
        self._graphs = [RobotGraph(robot, self._uri, prefix=robot) for robot in config.scenario.robots]

    async def start(self, group: ProgramGroup) -> str:
        """Start all programs; return the URL of the page."""
        config, uri = self._config, self._uri
        config.write_scene()
        if not config.core_uri:
            await self._start_core(group)
        host = RosHost("here", uri)
        robots = config.scenario.robots
        argv = [*world_argv(config, uri, dict.fromkeys(robots, uri)), "--services"]
        world = await host.start(group, "world", argv)
        await host.start(group, "planner", planner_argv(config), restartable=True)
        truth = await group.wait_line(world, "world ROS_MASTER_URI=", START_TIMEOUT)
        station = await host.start(group, "station", station_argv(config, uri, truth), restartable=True)
        for number, robot in enumerate(robots, start=1):
            await host.start(group, f"move_client{number}", move_client_argv(robot), restartable=True)
        page = await group.wait_line(station, "rce ui ready:", START_TIMEOUT)
        if not config.slam:
            await start_robots(group, config, self)
        await group.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    def graphs(self) -> Sequence[RobotGraph]:
        """Return where the nodes of each robot are: in its namespace."""
        return self._graphs

    def launch_arguments(self, graph: RobotGraph) -> Mapping[str, object]:
        """Return the arguments of the launch file of a robot's nodes; the first one's publish the map."""
        return {"tf_prefix": graph.prefix, "map_server": graph == self._graphs[0]}

    async def read_totals(self) -> MessageTotals:
        """Read the message totals of all nodes."""
        return await read_graph_totals([self._uri], node_names(self._graphs))

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

    Each robot's machine runs its core, its nodes and its move client; discovery and sync run on every
    machine. The simulated world has no core: it stands for the robots' hardware, and its nodes join the
    robots' cores.
    """

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._cores: list[str] = []
        self._graphs: list[RobotGraph] = []

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
        self._graphs = [RobotGraph(machine.name, machine.core_uri, host=machine.prefix) for machine in others]
        argv = world_argv(config, planner.core_uri, uris, namespaces=False)
        world = await world_host.start(group, "world", argv)
        station = await here.start(group, "station", station_argv(config, planner.core_uri), restartable=True)
        argv = planner_argv(config, answers=True)
        await _host_of(planner).start(group, "planner", argv, restartable=True)
        for number, machine in enumerate(others, start=1):
            argv = move_client_argv(machine.name, namespace=False, answers=True, **config.map_parameters)
            await _host_of(machine).start(group, f"move_client{number}", argv, restartable=True)
        await _join_machines(network, robots, group)
        page = await group.wait_line(station, "rce ui ready:", START_TIMEOUT)
        if not config.slam:
            await start_robots(group, config, self)
        await group.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    def graphs(self) -> Sequence[RobotGraph]:
        """Return where the nodes of each robot are: at its own core."""
        return self._graphs

    def launch_arguments(self, graph: RobotGraph) -> Mapping[str, object]:
        """Return the arguments of the launch file of a robot's nodes."""
        return {"robot": graph.robot}

    async def read_totals(self) -> MessageTotals:
        """Read the message totals of all nodes."""
        return await read_graph_totals(self._cores, node_names(self._graphs))


def sync_argv(machine: str, robots: Iterable[str]) -> list[str]:
    """Return the command of a machine's sync: the topics, and the machines that it takes them from."""
    if machine == PLANNER:
        topics = [f"/{robot}/{name}" for robot in robots for name in FROM_ROBOT]
        return [*rce_command("sync"), "--topics", ",".join(topics)]
    topics = [*(f"/{machine}/{name}" for name in TO_ROBOT), *TO_ALL]
    return [*rce_command("sync"), "--topics", ",".join(topics), "--hosts", PLANNER]


def discovery_argv(machine: DemoMachine, network: Network) -> list[str]:
    """Return the command of a machine's discovery."""
    options = {
        "--name": machine.name,
        "--mcast-group": f"{DEFAULT_GROUP}@{machine.address}",
        "--mcast-port": network.multicast_port,
        "--rpc-addr": machine.address,
        "--rpc-port": machine.rpc_port,
    }
    return [*rce_command("discovery"), *(str(part) for item in options.items() for part in item)]


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
