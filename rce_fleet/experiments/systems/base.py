"""What a system under test does: it connects programs on two machines by topics."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, ClassVar

from rce.aio.tasks import errors_in
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, client

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterator, Sequence

    from rce_fleet.experiments.bench import Bench, Program
    from rce_fleet.experiments.systems.software import Software

PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class Flow:
    """A topic that goes from one machine to the other, or a service that one offers to the other.

    Attributes:
        topic: Its name on both.
        kind: Its type.
        to: The machine that gets the topic, or uses the service.
        robot: Number of the robot that it belongs to, from 1.
        from_client: Whether its source is a client of the engine itself, where there is an engine.
        is_service: Whether it is a service.
    """

    topic: str
    kind: str
    to: str = SERVER
    robot: int = 1
    from_client: bool = False
    is_service: bool = False


@dataclass(frozen=True, slots=True)
class Workload:
    """A program of the experiments.

    Attributes:
        name: Its name in the run.
        program: Its module in :mod:`rce_fleet.experiments.workloads`.
        arguments: Its command line.
        machine: Where it runs.
        robot: The robot whose container it runs in, where there are containers for each.
        is_client: Whether it is a client of the engine itself, without a ROS graph, where there is an engine.
    """

    name: str
    program: str
    arguments: tuple[str, ...]
    machine: str
    robot: int = 1
    is_client: bool = False


@dataclass(frozen=True, slots=True)
class Layout:
    """How the machines are used, beyond what the system says.

    Attributes:
        robots: Number of robots.
        own_machines: Whether each robot has a machine of its own; else all are on the client.
        containers: Whether all robots share one container, ``one``, or have one ``each``; in systems that
            have none it makes no difference.
        server_graph: Whether programs on the server run in a ROS graph of its own instead of a container.
    """

    robots: int = 1
    containers: str = "one"
    server_graph: bool = False
    own_machines: bool = False

    def machine_of(self, robot: int) -> str:
        """Return the machine of a robot."""
        return client(robot) if self.own_machines else CLIENT

    @property
    def clients(self) -> tuple[str, ...]:
        """The machines with robots."""
        return tuple(dict.fromkeys(self.machine_of(robot) for robot in range(1, self.robots + 1)))


class RunningWorkload(ABC):
    """A program of the experiments that runs."""

    @abstractmethod
    async def lines(self) -> list[str]:
        """Return the lines of its standard output so far, as far as they are kept.

        Raises:
            ExperimentError: They cannot be read.
        """

    @abstractmethod
    async def wait_ready(self) -> None:
        """Wait until it is ready.

        Raises:
            ExperimentError: It ended, or was not ready in time.
        """

    @abstractmethod
    async def end(self) -> None:
        """End it."""


class System(ABC):
    """A system under test on a bench.

    Args:
        bench: The machines.
        software: Of the robots.
        layout: How the machines are used.
    """

    name: ClassVar[str]
    """As in the results."""
    title: ClassVar[str]
    """The paper's short name."""
    core_machine: ClassVar[str] = SERVER
    """The machine whose core, started by :meth:`start_core`, is killed in the experiment ``robustness``."""
    has_master: ClassVar[bool] = False
    """Whether there is something beside the cores that connects the machines, and can be killed."""
    has_containers: ClassVar[bool] = False
    """Whether programs on the server run in containers."""
    has_one_core: ClassVar[bool] = False
    """Whether all machines use the server's ROS core."""

    def __init__(self, bench: Bench, software: Software, layout: Layout) -> None:
        self.bench = bench
        self.software = software
        self.layout = layout
        self.robots_at = 0.0
        """When the first program of a robot was started, seconds since 1970."""
        self._cores: dict[str, Program] = {}
        self._restarts = count(2)

    async def start(self, flows: Sequence[Flow], workloads: Sequence[Workload]) -> list[RunningWorkload]:
        """Start what connects the machines, and the first programs.

        Args:
            flows: All topics that will go from one machine to the other.
            workloads: The programs.

        Raises:
            ExperimentError: A program does not start.
        """
        await self.connect(flows)
        self.robots_at = time.time()
        return [await self.run(workload) for workload in workloads]

    @abstractmethod
    async def connect(self, flows: Sequence[Flow]) -> None:
        """Start what connects the machines.

        Raises:
            ExperimentError: A program does not start.
        """

    @abstractmethod
    async def run(self, workload: Workload) -> RunningWorkload:
        """Run a program of the experiments.

        Raises:
            ExperimentError: It does not start.
        """

    @classmethod
    def wiring(cls, robot: int) -> dict[str, str] | None:
        """Return the files that have to be written for one more robot with a scan: name and text.

        None: that is not known.
        """
        del robot
        return None

    async def start_core(self, machine: str) -> Program:
        """Start a ROS core on a machine."""
        address = self.bench.address(machine)
        again = f"-{next(self._restarts)}" if machine in self._cores else ""
        self._cores[machine] = await self.bench.start(
            machine,
            f"core-{machine}{again}",
            self.software.core(address),
            environ={"ROS_MASTER_URI": core_uri(address)},
            ready=self.software.core_ready,
        )
        return self._cores[machine]

    async def kill_core(self) -> None:
        """Kill the core of the machine ``core_machine``.

        Raises:
            ExperimentError: It has none.
        """
        if self.core_machine not in self._cores:
            raise ExperimentError(
                f"{self.title}: no core was started on {self.core_machine}; name a machine that has one as "
                f"{type(self).__name__}.core_machine ({', '.join(self._cores) or 'none has one'})"
            )
        await self.bench.kill(self._cores[self.core_machine])

    async def restart_core(self) -> None:
        """Start it again, as a supervisor would.

        Raises:
            ExperimentError: It does not start.
        """
        await self.start_core(self.core_machine)

    async def kill_master(self) -> None:
        """Kill what connects the machines on machine 1.

        Raises:
            ExperimentError: There is nothing, or it is not known how.
        """
        raise ExperimentError(f"{self.title}: there is no master that can be killed")

    async def restart_master(self) -> None:  # noqa: B027 - where it restarts by itself, nothing is to be done
        """Start it again, as a supervisor would."""

    async def run_in_graph(self, workload: Workload, core: str) -> RunningWorkload:
        """Run a program in the graph of the ROS core on the machine ``core``."""
        environ = {
            **self.software.environ(self.bench.folder),
            "ROS_MASTER_URI": core_uri(self.bench.address(core)),
        }
        argv = (*self.software.workload(workload.program), *workload.arguments)
        program = await self.bench.start(workload.machine, workload.name, argv, environ=environ)
        return RunningProgram(self.bench, program)


class RunningProgram(RunningWorkload):
    """A program that was started on a machine of the bench.

    Args:
        bench: The machines.
        program: The program.
    """

    def __init__(self, bench: Bench, program: Program) -> None:
        self._bench = bench
        self._program = program

    async def lines(self) -> list[str]:
        """Return the lines of its output so far."""
        return self._program.lines()

    async def wait_ready(self) -> None:
        """Wait until it is ready."""
        await self._bench.wait_for(self._program, "ready", timeout=PATIENCE_S)

    async def end(self) -> None:
        """End it."""
        await self._bench.end(self._program)


async def together(*works: Coroutine[object, object, object]) -> None:
    """Do several things at the same time.

    Raises:
        ExperimentError, OSError: One of them cannot be done; the others are cancelled.
    """
    try:
        async with asyncio.TaskGroup() as tasks:
            for work in works:
                tasks.create_task(work)
    except* (ExperimentError, OSError) as errors:
        raise next(errors_in(errors)) from None


def core_uri(address: str) -> str:
    """Return the URI of the ROS core on a machine."""
    return f"http://{address}:11311/"


def other(machine: str) -> str:
    """Return the other machine."""
    return CLIENT if machine == SERVER else SERVER


def robots_of(flows: Sequence[Flow], robots: int) -> Iterator[tuple[int, list[Flow]]]:
    """Yield each robot's number with its flows."""
    for robot in range(1, robots + 1):
        yield robot, [flow for flow in flows if flow.robot == robot]
