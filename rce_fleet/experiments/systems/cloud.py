"""The paper's Cloud Robotics System: an engine on the server, ``rce-ros`` for each robot on the client.

Programs on the server run in containers, or, in the layout ``server_graph``, in a ROS graph of the server's
own that is connected as a robot too.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from typing import TYPE_CHECKING, Any

from rce.config import SecretError, new_secret
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments import engine_login, node_log
from rce_fleet.experiments.bench import CLIENT, SERVER, TAIL_LINES
from rce_fleet.experiments.systems.base import (
    PATIENCE_S,
    RunningProgram,
    RunningWorkload,
    System,
    Workload,
    core_uri,
    robots_of,
    together,
)
from rce_fleet.experiments.systems.software import PACKAGE, RCE
from rce_fleet.experiments.workloads.client_graph import CONFIG, tag_of
from rce_fleet.experiments.workloads.graph import SOFTWARE
from rce_fleet.experiments.workloads.telling import READY

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rce_fleet.experiments.bench import Bench, Program
    from rce_fleet.experiments.systems.base import Flow, Layout
    from rce_fleet.experiments.systems.software import Software

USER = "researcher"
PASSWORD = "experiment"  # noqa: S105 - of an engine that only the machines of one run reach
OPERATOR = "server"
"""Robot id of the server's own graph."""
LOGIN = "login.json"
"""The operator's token, in the folder of the run."""
POLL_S = 0.2
_accounts: dict[str, bytes] = {}
"""The files of an engine's state that has only the user for the robots, by name."""


class Cloud(System):
    """An engine; the robots' ROS graph is on the client."""

    name = "cloud"
    title = "CRS"
    core_machine = CLIENT
    has_master = True
    has_containers = True

    def __init__(self, bench: Bench, software: Software, layout: Layout) -> None:
        super().__init__(bench, software, layout)
        self._nodes: dict[int, list[dict[str, str]]] = {}
        """The nodes in containers that a robot's config starts, by robot."""
        self._agents: dict[int, Program] = {}
        self._engine: Program | None = None

    async def start(self, flows: Sequence[Flow], workloads: Sequence[Workload]) -> list[RunningWorkload]:
        """Start engine, cores and agents; a robot's config starts the nodes in its container."""
        for workload in workloads:
            if self._is_in_container(workload):
                self._nodes.setdefault(self._owner(workload.robot), []).append(self._node(workload))
        await self.connect(flows)
        running: list[RunningWorkload] = []
        for workload in workloads:
            if self._is_in_container(workload):
                agent = self._agents[self._owner(workload.robot)]
                running.append(NodeInContainer(self.bench, agent, self._name(workload)))
            else:
                running.append(await self.run(workload))
        return running

    async def connect(self, flows: Sequence[Flow]) -> None:
        """Start the engine, the cores of robots' machines, and an agent for each robot."""
        await together(self.start_engine(), *(self.start_core(machine) for machine in self._graphs()))
        if self.layout.server_graph:
            agent = {**self.account(OPERATOR), "interfaces": [_at_graph(OPERATOR, flow) for flow in flows]}
            await self.start_agent(SERVER, OPERATOR, agent)
        self.robots_at = time.time()
        robots = dict(robots_of(flows, self.layout.robots))
        # The others use the container of the first one.
        first = [self._robot(1, robots.pop(1))]
        if not self.layout.server_graph:  # else nodes in containers write nothing that is read
            first.append(self._log_in())
        await together(*first)
        await together(*(self._robot(robot, own) for robot, own in robots.items()))

    async def run(self, workload: Workload) -> RunningWorkload:
        """Run a program on the client, in the server's own graph, or, by another agent, in a container."""
        if workload.is_client:
            return await self._client(workload)
        if not self._is_in_container(workload):
            return await self.run_in_graph(workload, workload.machine)
        name = f"of_{workload.name}"
        config = {**self.account(name), "nodes": [self._node(workload)]}
        agent = await self.start_agent(CLIENT, name, config)
        return NodeInContainer(self.bench, agent, self._name(workload))

    def config(self, robot: int, flows: Sequence[Flow]) -> dict[str, Any]:
        """Return the config of a robot."""
        name = f"robot{robot}"
        account = self.account(name)
        if self.layout.server_graph:
            return {
                **account,
                "interfaces": [_at_robot(name, flow) for flow in flows],
                "connections": [_between(name, flow) for flow in flows],
            }
        owns = self._owner(robot) == robot
        container = self._container(robot)
        return {
            **account,
            "containers": [{"cTag": container}] if owns else [],
            "nodes": self._nodes.get(robot, []),
            "interfaces": [_in_container(container, flow) for flow in flows if flow.from_client],
            "bridges": [_bridge(flow, container) for flow in flows if not flow.from_client],
        }

    @classmethod
    def wiring(cls, robot: int) -> dict[str, str]:
        """Return a robot's config file."""
        config = {
            "url": "http://server:9000/",
            "userID": USER,
            "password": PASSWORD,
            "robotID": f"robot{robot}",
            "bridges": [
                {
                    "topic": "/scan",
                    "type": "sensor_msgs/LaserScan",
                    "from": "robot",
                    "to": f"box:/Robot{robot}/scan",
                }
            ],
        }
        return {f"robot{robot}.config": json.dumps(config, indent=4) + "\n"}

    def _container(self, robot: int) -> str:
        return f"box{robot}" if self.layout.containers == "each" else "box"

    async def _client(self, workload: Workload) -> RunningWorkload:
        config = self.bench.folder / f"{workload.name}.json"
        container = self._container(workload.robot)
        config.write_text(json.dumps({**self.account(workload.name), "container": container}))
        argv = (*RCE.workload(workload.program), *workload.arguments)
        environ = {SOFTWARE: "client", CONFIG: str(config)}
        program = await self.bench.start(workload.machine, workload.name, argv, environ=environ)
        return RunningProgram(self.bench, program)

    def _owner(self, robot: int) -> int:
        return robot if self.layout.containers == "each" else 1

    def _is_in_container(self, workload: Workload) -> bool:
        return workload.machine == SERVER and not self.layout.server_graph

    def _name(self, workload: Workload) -> str:
        return f"{self._container(workload.robot)}/{workload.name}"

    def _node(self, workload: Workload) -> dict[str, str]:
        return {
            "cTag": self._container(workload.robot),
            "nTag": workload.name,
            "pkg": PACKAGE,
            "exe": workload.program,
            "args": " ".join(workload.arguments),
        }

    def account(self, robot: str) -> dict[str, Any]:
        """Return the first part of a robot's config: where and as whom it logs in."""
        url = f"http://{self.bench.address(SERVER)}:9000/"
        return {"url": url, "userID": USER, "password": PASSWORD, "robotID": robot}

    async def start_engine(self, *, packages: Path | None = None) -> None:
        """Start the engine on the server, with a user for the robots.

        Args:
            packages: A folder with packages for containers.

        Raises:
            ExperimentError: It does not start.
        """
        bench = self.bench
        state = bench.folder / "engine"
        secret = bench.folder / "secret"
        try:
            await asyncio.to_thread(new_secret, secret)
        except SecretError as error:
            raise ExperimentError(str(error)) from error
        await self._add_user(state)
        words = ("--no-offer-images", "--bind", bench.address(SERVER), "--secret-file", str(secret))
        up: tuple[str, ...] = ("rce", "up", *words, "--state-dir", str(state))
        if packages is not None:
            up += ("--package-path", str(packages))
        self._engine = await bench.start(SERVER, "engine", up, ready="RCE ready")

    async def _add_user(self, state: Path) -> None:
        """Have the engine's state have a user for the robots: made once, and then copied."""
        master = state / "master"
        if not _accounts:
            add = ("rce", "user", "add", USER, "--admin", "--password-stdin", "--state-dir", str(state))
            await self.bench.run(SERVER, "user", add, given=PASSWORD)
            _accounts.update({file.name: file.read_bytes() for file in master.glob("*.sqlite*")})
            return
        master.mkdir(mode=0o700, parents=True)
        for name, data in _accounts.items():
            (master / name).write_bytes(data)

    async def kill_master(self) -> None:
        """Kill the engine's master; ``rce up`` starts it again by itself."""
        assert self._engine is not None
        await self.bench.kill(self._engine, part="-m rce_master ")

    async def _log_in(self) -> None:
        url = f"http://{self.bench.address(SERVER)}:9000/"
        file = str(self.bench.folder / LOGIN)
        login = (sys.executable, "-I", "-S", engine_login.__file__, url, USER, file)
        await self.bench.run(SERVER, "login", login, given=PASSWORD)

    def _graphs(self) -> tuple[str, ...]:
        return (*self.layout.clients, *([SERVER] if self.layout.server_graph else []))

    async def _robot(self, robot: int, flows: Sequence[Flow]) -> None:
        config = self.config(robot, flows)
        machine = self.layout.machine_of(robot)
        self._agents[robot] = await self.start_agent(machine, f"robot{robot}", config)

    async def start_agent(
        self, machine: str, name: str, config: dict[str, Any], *, core: str = ""
    ) -> Program:
        """Start ``rce-ros`` with a config, and wait until it is connected.

        Args:
            machine: Where.
            name: Names its config and its output.
            config: The config.
            core: Address of its ROS core; empty: that of the machine.

        Raises:
            ExperimentError: It does not start.
        """
        path = self.bench.folder / f"{name}.config"
        path.write_text(json.dumps(config))
        return await self.bench.start(
            machine,
            f"agent-{name}",
            ("rce-ros", str(path)),
            environ={"ROS_MASTER_URI": core_uri(core or self.bench.address(machine))},
            ready="rce-ros ready",
        )


class NodeInContainer(RunningWorkload):
    """A program in a container, which the agent that created it holds.

    Args:
        bench: The machines.
        agent: The agent.
        node: The node as ``CONTAINER/NODE``.
    """

    def __init__(self, bench: Bench, agent: Program, node: str) -> None:
        self._bench = bench
        self._agent = agent
        self._node = node

    async def lines(self) -> list[str]:
        """Return what is kept of its output: the newest one to two megabytes."""
        login = str(self._bench.folder / LOGIN)
        read = (sys.executable, "-I", "-S", node_log.__file__, login, *self._node.split("/"))
        return (await self._bench.run(SERVER, f"log of {self._node}", read)).splitlines()

    async def wait_ready(self) -> None:
        """Wait until it is ready."""
        deadline = time.monotonic() + PATIENCE_S
        while READY not in (lines := await self.lines()):
            if time.monotonic() > deadline:
                shown = "".join(f"\n    {line}" for line in lines[-TAIL_LINES:])
                raise ExperimentError(f"{self._node} did not become ready within {PATIENCE_S:g} s:{shown}")
            await asyncio.sleep(POLL_S)

    async def end(self) -> None:
        """End it."""
        await self._bench.end(self._agent)


def _tag(flow: Flow) -> str:
    return tag_of(flow.topic)


def _at_robot(name: str, flow: Flow) -> dict[str, str]:
    kind = "SubscriberForwarder" if flow.to == SERVER else "PublisherForwarder"
    return {"eTag": name, "iTag": _tag(flow), "iType": kind, "iCls": flow.kind, "addr": flow.topic}


def _at_graph(name: str, flow: Flow) -> dict[str, str]:
    kind = "PublisherForwarder" if flow.to == SERVER else "SubscriberForwarder"
    return {"eTag": name, "iTag": _tag(flow), "iType": kind, "iCls": flow.kind, "addr": flow.topic}


def _in_container(container: str, flow: Flow) -> dict[str, str]:
    kind = "PublisherInterface"
    return {"eTag": container, "iTag": _tag(flow), "iType": kind, "iCls": flow.kind, "addr": flow.topic}


def _between(name: str, flow: Flow) -> dict[str, str]:
    return {"tagA": f"{name}/{_tag(flow)}", "tagB": f"{OPERATOR}/{_tag(flow)}"}


def _bridge(flow: Flow, container: str) -> dict[str, str]:
    near, far = ("robot", container) if flow.to == SERVER else (container, "robot")
    if flow.is_service:
        return {"service": flow.topic, "type": flow.kind, "server": near, "clients": far}
    return {"topic": flow.topic, "type": flow.kind, "from": near, "to": far}
