"""The programs of a demo: started, logged to files, restarted if they end, and stopped together."""

from __future__ import annotations

import asyncio
import sys
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias, TypeVar

from rce.supervision.process import Child
from rce_fleet.demo.exceptions import NotReadyError, ProgramEndedError, describe_exit

RCE = (sys.executable, "-c", "from rce.cli import main; main()")
"""Command of the ``rce`` program of this installation."""
START_TIMEOUT = 90.0
"""Seconds for one program to start, on a machine that starts many at once."""
TAIL_LINES = 25
"""How many of a program's last lines an error shows."""
STOP_TIMEOUT = 15.0
LAST_STOP_TIMEOUT = 90.0
DRAIN_TIMEOUT = 1.0
"""Seconds to read the rest of an ended program's output; its own children may keep the pipe open."""

MIN_UPTIME = 10.0
"""A program that ran this long started well: its count of early exits begins again."""
MAX_EARLY_EXITS = 5
MIN_RESTART_DELAY, MAX_RESTART_DELAY = 0.5, 5.0
"""Seconds before the first and, after doubling each time, before any later restart."""

T = TypeVar("T")
StartAgain: TypeAlias = Callable[[], Coroutine[Any, Any, Child]]
"""Starts a program's process once more."""


class Program:
    """A program of the demo.

    Attributes:
        child: Its process; a new one after each restart.
        stop_last: Other programs need it while they stop: it is stopped after them.
        restartable: It can be restarted while the others run.
        early_exits: How often in a row it ended soon after its start.
    """

    def __init__(
        self, child: Child, log: Path, start_again: StartAgain, *, stop_last: bool, restartable: bool
    ) -> None:
        self.child = child
        self.log = log
        self.start_again = start_again
        self.stop_last = stop_last
        self.restartable = restartable
        self.early_exits = 0
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.lines: deque[str] = deque(maxlen=1000)
        self._printed = asyncio.Event()

    def add_line(self, line: str) -> None:
        """Add a line that it printed."""
        self.tail.append(line)
        self.lines.append(line)
        self._printed.set()

    async def wait_line(self, start: str) -> str:
        """Wait for a line that begins with ``start``; return the rest of the line."""
        while True:
            for line in self.lines:
                if line.startswith(start):
                    return line[len(start) :].strip()
            self._printed.clear()
            await self._printed.wait()


class ProgramGroup:
    """Programs that belong together. An async context manager that stops all of them on exit.

    Programs with ``stop_last`` are stopped after the others, in reverse order of their start.

    Args:
        folder: Where each program's output is written, as ``NAME.log``.
        show: Called with every line that a program prints.
    """

    def __init__(self, folder: Path, show: Callable[[str], None]) -> None:
        self._folder = folder
        self._show = show
        self._programs: list[Program] = []
        self._readers = asyncio.TaskGroup()
        self._report_restart: Callable[[str], None] | None = None
        self._failure: asyncio.Future[ProgramEndedError] = asyncio.get_running_loop().create_future()
        self._stopping: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done once the group stops its programs."""

    async def __aenter__(self) -> Self:
        await self._readers.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set_result(None)
        try:
            await self._stop_all()
        finally:
            await self._readers.__aexit__(None, None, None)

    def enable_restarts(self, report: Callable[[str], None]) -> None:
        """Restart programs that are restartable from now on; ``report`` gets a line for each restart."""
        self._report_restart = report

    async def start(
        self,
        name: str,
        argv: Sequence[str],
        *,
        env: Mapping[str, str] | None = None,
        stop_last: bool = False,
        restartable: bool = False,
    ) -> Program:
        """Start a program.

        Args:
            name: Name in its log file and in messages.
            argv: Its command line.
            env: Environment variables to change.
            stop_last: Other programs need it while they stop: stop it after them.
            restartable: It can be restarted while the others run; see :meth:`enable_restarts`.
        """

        async def start_again() -> Child:
            return await Child.start(name, argv, env=env)

        log = self._folder / f"{name}.log"
        program = Program(await start_again(), log, start_again, stop_last=stop_last, restartable=restartable)
        self._programs.append(program)
        self._readers.create_task(self._supervise(program), name=f"output of {name}")
        return program

    async def wait_line(self, program: Program, start: str, timeout: float) -> str:
        """Wait until a program prints a line that begins with ``start``; return the rest of the line.

        Raises:
            NotReadyError: It did not print one within ``timeout`` seconds.
        """
        try:
            async with asyncio.timeout(timeout):
                return await program.wait_line(start)
        except TimeoutError:
            printed = "".join(f"\n    {line}" for line in program.tail)
            raise NotReadyError(
                f"{program.child.name} was not ready within {timeout:.0f} s{printed}"
            ) from None

    async def run_while_alive(self, work: Coroutine[Any, Any, T]) -> T:
        """Run ``work`` and return its result, as long as all programs run or are restarted.

        Raises:
            ProgramEndedError: A program ended and was not restarted; the work was cancelled.
        """
        task = asyncio.create_task(work)
        try:
            await asyncio.wait((task, self._failure), return_when=asyncio.FIRST_COMPLETED)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        if self._failure.done():
            raise self._failure.result()
        return task.result()

    async def _supervise(self, program: Program) -> None:
        """Log a program's output, and restart it if enabled."""
        while True:
            code = await self._watch(program)
            if not await self._restart(program, code):
                if not self._stopping.done() and not self._failure.done():
                    self._failure.set_result(ProgramEndedError(program.child.name, code, program.tail))
                return

    async def _restart(self, program: Program, code: int) -> bool:
        """Restart a program that ended; return False if it must not or cannot be restarted."""
        over = self._stopping.done() or self._failure.done()
        if (
            over
            or self._report_restart is None
            or not program.restartable
            or program.early_exits >= MAX_EARLY_EXITS
        ):
            return False
        delay = min(MAX_RESTART_DELAY, MIN_RESTART_DELAY * 2 ** (program.early_exits - 1))
        self._report_restart(f"{program.child.name} {describe_exit(code)}; restarting it")
        await asyncio.wait((self._stopping,), timeout=delay)
        if self._stopping.done():
            return False
        try:
            program.child = await program.start_again()
        except OSError as error:
            program.add_line(str(error))
            return False
        if self._stopping.done():
            await program.child.stop(timeout=STOP_TIMEOUT)
        return True

    async def _watch(self, program: Program) -> int:
        """Log what a program prints until it ends; return its exit code."""
        child, started = program.child, asyncio.get_running_loop().time()
        reading = asyncio.create_task(self._log(program))
        try:
            code = await child.wait()
            await asyncio.wait((reading,), timeout=DRAIN_TIMEOUT)
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
        uptime = asyncio.get_running_loop().time() - started
        program.early_exits = program.early_exits + 1 if uptime < MIN_UPTIME else 1
        return code

    async def _log(self, program: Program) -> None:
        with program.log.open("a", encoding="utf-8", buffering=1) as log:
            async for line in program.child.lines():
                log.write(f"{line}\n")
                program.add_line(line)
                self._show(f"[{program.child.name}] {line}")

    async def _stop_all(self) -> None:
        async with asyncio.TaskGroup() as stops:
            for program in self._programs:
                if not program.stop_last:
                    stops.create_task(program.child.stop(timeout=STOP_TIMEOUT))
        for program in reversed(self._programs):
            if program.stop_last:
                await program.child.stop(timeout=LAST_STOP_TIMEOUT)
