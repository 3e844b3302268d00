"""The machines of one run with their links and meters, and the programs that were started on them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Self

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.delay_line import LinkShape
from rce_fleet.experiments.machines import LinkFigures, Machine, MachineLink, MachineNetwork, Traffic
from rce_fleet.experiments.ownership import command_line, end_all, family, new_tag
from rce_fleet.experiments.usage import Meter, Usage, make_meter, processes_in

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from types import TracebackType

SERVER, CLIENT = "server", "client"
"""The paper's machine 1, and its machine 2 with the robots."""
RATE = 50e6
"""The wireless LAN's rate, bits per second in each direction."""
DELAY_S, JITTER_S = 0.005, 0.001
"""Its delay and jitter in each direction, seconds."""
POLL_S = 0.02
START_S = 60.0
"""How long a program may take until it is ready, seconds."""
END_S = 10.0
"""How long programs may take to end when they are told to."""
TAIL_LINES = 5
"""Lines of a program's output that an error shows."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What a machine has used and carried until a time.

    Attributes:
        at: Seconds since 1970.
        usage: Of its programs.
        traffic: Of its interface.
    """

    at: float
    usage: Usage
    traffic: Traffic


@dataclass(slots=True)
class Program:
    """A program that was started on a machine.

    Attributes:
        name: Its name in the run.
        machine: The machine's name.
        output: File with its standard output and standard error.
        process: The process.
    """

    name: str
    machine: str
    output: Path
    process: asyncio.subprocess.Process = field(repr=False)

    def lines(self) -> list[str]:
        """Return the whole lines of its output so far."""
        text = self.output.read_text(errors="replace")
        return text[: text.rfind("\n") + 1].splitlines()

    def check(self) -> None:
        """Make sure that it runs.

        Raises:
            ExperimentError: It has ended; the text has its last lines.
        """
        if self.process.returncode is not None:
            raise ExperimentError(f"{self.name} ended with {self.process.returncode}:{self.tail()}")

    def tail(self) -> str:
        """Return the last lines of its output, for an error."""
        return "".join(f"\n    {line}" for line in self.lines()[-TAIL_LINES:])


class Bench:
    """Machines, while the ``async with`` block runs; all that was started on them ends with it.

    Args:
        clients: Number of machines with robots.
        delay: Of a client's link, seconds in each direction.
        rate: Of its link, bits per second.
        seed: Of jitter.

    Attributes:
        folder: For the files of the run; it is removed at the end.
        meters: What the machines use, by their names.
    """

    def __init__(
        self, *, clients: int = 1, delay: float = DELAY_S, rate: float = RATE, seed: int = 0
    ) -> None:
        self._tag = new_tag()
        links = {client(number): MachineLink(rate, shape_of(delay)) for number in range(1, clients + 1)}
        self._network = MachineNetwork({SERVER: MachineLink()} | links, seed=seed, tag=self._tag)
        self._stack = AsyncExitStack()
        self._programs: list[Program] = []
        self.folder = Path()
        self.meters: dict[str, Meter] = {}

    async def __aenter__(self) -> Self:
        """Make the machines.

        Raises:
            ExperimentError: They cannot be made; the text says what is missing.
        """
        async with AsyncExitStack() as stack:
            self.folder = Path(tempfile.mkdtemp(prefix=f"{self._tag}-"))
            stack.callback(shutil.rmtree, self.folder, ignore_errors=True)
            await stack.enter_async_context(self._network)
            for name, machine in self._network.machines.items():
                self.meters[name] = make_meter(f"{self._tag}-{name}", machine.namespace)
                stack.callback(self.meters[name].close)
            stack.push_async_callback(self.end_programs)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all programs and remove the machines."""
        await self._stack.aclose()

    def address(self, machine: str) -> str:
        """Return a machine's address."""
        return self._network.machines[machine].address

    async def start(
        self,
        machine: str,
        name: str,
        argv: Sequence[str],
        *,
        environ: Mapping[str, str] | None = None,
        ready: str = "",
        is_metered: bool = True,
    ) -> Program:
        """Start a program.

        Args:
            machine: Where.
            name: A name for it, which its output is kept by.
            argv: Its command line.
            environ: Environment variables beside those that every program has.
            ready: Wait for a line of its output with this text.
            is_metered: Whether it counts as a program of the machine.

        Raises:
            ExperimentError: It cannot be started, ended, or was not ready in time.
        """
        place = self._network.machines[machine]
        output = self.folder / f"{name}.log"
        prefix = self.meters[machine].prefix if is_metered else ()
        try:
            with output.open("ab") as file:
                process = await asyncio.create_subprocess_exec(
                    *(*prefix, *place.prefix, "setpriv", "--pdeathsig", "TERM", *argv),
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=file,
                    stderr=asyncio.subprocess.STDOUT,
                    env=self._environ(place) | dict(environ or {}),
                    cwd=self.folder,
                    start_new_session=True,
                )
        except OSError as error:
            raise ExperimentError(f"{name} cannot be started: {error}") from error
        program = Program(name, machine, output, process)
        self._programs.append(program)
        if ready:
            await self.wait_for(program, ready)
        return program

    async def run(self, machine: str, name: str, argv: Sequence[str], *, given: str = "") -> str:
        """Run a program that does not count to its end, and return its output.

        Args:
            machine: Where.
            name: A name for it.
            argv: Its command line.
            given: Its standard input.

        Raises:
            ExperimentError: It ended with an error.
        """
        place = self._network.machines[machine]
        process = await asyncio.create_subprocess_exec(
            *(*place.prefix, "setpriv", "--pdeathsig", "KILL", *argv),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=self._environ(place),
            cwd=self.folder,
        )
        try:
            async with asyncio.timeout(START_S):
                out, error = await process.communicate(given.encode())
        except TimeoutError:
            raise ExperimentError(f"{name} did not end within {START_S:g} s") from None
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode:
            raise ExperimentError(f"{name} ended with {process.returncode}: {error.decode(errors='replace')}")
        return out.decode(errors="replace")

    async def wait_for(self, program: Program, text: str, *, timeout: float = START_S) -> None:
        """Wait for a line of a program's output with a text.

        Raises:
            ExperimentError: The program ended, or there was none in time.
        """
        await self.wait_until(
            lambda: any(text in line for line in program.lines()),
            lambda: f"{program.name} did not print {text!r} within {timeout:g} s:{program.tail()}",
            timeout=timeout,
        )

    async def wait_until(
        self, condition: Callable[[], bool], otherwise: Callable[[], str], *, timeout: float = START_S
    ) -> None:
        """Wait until something holds.

        Raises:
            ExperimentError: It did not in time, with the text of ``otherwise``, or a program ended.
        """
        deadline = time.monotonic() + timeout
        while not condition():
            self.check()
            if time.monotonic() > deadline:
                raise ExperimentError(otherwise())
            await asyncio.sleep(POLL_S)

    def check(self) -> None:
        """Make sure that all programs run.

        Raises:
            ExperimentError: One has ended.
        """
        for program in self._programs:
            program.check()

    async def read(self, machine: str) -> Reading:
        """Read a machine's meters."""
        traffic = await self._network.traffic(machine)
        return Reading(time.time(), self.meters[machine].read(), traffic)

    async def probe(self, machine: str, other: str) -> LinkFigures:
        """Measure the way from one machine to another and back.

        Raises:
            ExperimentError: The other one is not reached.
        """
        return await self._network.probe(machine, other)

    async def emulation_s(self) -> float:
        """Return the processor time that the link's emulator took so far, seconds."""
        return await self._network.emulation_s()

    async def set_delay(self, delay: float) -> None:
        """Give the client's link another delay, seconds in each direction."""
        await self._network.reshape(CLIENT, shape_of(delay))

    async def cut(self, machine: str, *, is_cut: bool) -> None:
        """Have a client's link lose everything, or give it its usual shape again."""
        await self._network.reshape(machine, LinkShape(loss=1.0) if is_cut else shape_of(DELAY_S))

    async def set_rate(self, rate: float) -> None:
        """Give the client's link another rate, bits per second in each direction."""
        await self._network.set_rate(CLIENT, rate)

    async def end(self, program: Program, *, number: signal.Signals = signal.SIGTERM) -> None:
        """End one program."""
        self._programs.remove(program)
        await _end([program], number)

    async def kill(self, program: Program, *, part: str = "") -> None:
        """Kill a program, its processes' children included, as ``kill -9`` does.

        Args:
            program: The program.
            part: Kill only those of its processes whose command line has this word; the others run on.

        Raises:
            ExperimentError: No process has the word.
        """
        pids = [pid for pid in family(program.process.pid) if not part or part in command_line(pid)]
        if not pids:
            raise ExperimentError(f"{program.name} has no process with {part!r} in its command line")
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if not part:
            self._programs.remove(program)
            await program.process.wait()

    async def end_programs(self) -> None:
        """End all programs, and then whatever is left on the machines."""
        programs, self._programs = self._programs, []
        await _end(programs, signal.SIGTERM)
        await asyncio.to_thread(end_all, self._processes)

    def _processes(self) -> set[int]:
        """Return the ids of all processes that run for the bench."""
        found = set().union(*(meter.processes() for meter in self.meters.values()))
        return found.union(*(processes_in(one.namespace) for one in self._network.machines.values()))

    def _environ(self, machine: Machine) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if _is_for_programs(name)}
        folder = str(Path(sys.executable).parent)
        return kept | {
            "HOME": str(self.folder),
            "PATH": f"{folder}:{os.environ.get('PATH', os.defpath)}",
            "PYTHONUNBUFFERED": "1",
            "ROS_IP": machine.address,
            "ROS_HOME": str(self.folder / f"{machine.name}-ros"),
        }


def client(number: int) -> str:
    """Return the name of a machine with robots, from 1."""
    return CLIENT if number == 1 else f"{CLIENT}{number}"


def shape_of(delay: float) -> LinkShape:
    """Return the shape of a link with a delay, seconds; jitter is that of a wireless LAN, or less."""
    return LinkShape(delay=delay, jitter=min(JITTER_S, delay))


def _is_for_programs(variable: str) -> bool:
    """Return whether programs on machines get an environment variable of this process.

    They have settings of their own, and no way to the computer's proxy.
    """
    return not variable.startswith(("ROS_", "RCE_")) and not variable.lower().endswith("_proxy")


async def _end(programs: list[Program], number: signal.Signals) -> None:
    for program in programs:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.process.pid, number)
    async with asyncio.TaskGroup() as tasks:
        for program in programs:
            tasks.create_task(_ended(program))


async def _ended(program: Program) -> None:
    try:
        async with asyncio.timeout(END_S):
            await program.process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.process.pid, signal.SIGKILL)
        await program.process.wait()
