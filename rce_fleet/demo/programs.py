"""The programs of a demo: started, logged to files, restarted if they end, and stopped together."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from rce.aio.backoff import Backoff
from rce.aio.tasks import cancel_and_wait, finish
from rce.supervision.keeper import Keeper, RestartPolicy
from rce.supervision.process import Child
from rce_fleet.demo.exceptions import NotReadyError, ProgramEndedError, describe_exit

RCE = (sys.executable, "-c", "from rce.cli import main; main()")
"""Command of the ``rce`` program of this installation."""


def rce_command(name: str) -> list[str]:
    """Return the command line of one command of ``rce``; it starts faster than all of them."""
    (command,) = entry_points(group="rce.commands", name=name)
    code = f"import typer; from {command.module} import {command.attr}; typer.run({command.attr})"
    return [sys.executable, "-c", code]


START_TIMEOUT = 90.0
"""Seconds for one program to start, on a machine that starts many at once."""
TAIL_LINES = 25
"""How many of a program's last lines an error shows."""
STOP_TIMEOUT = 15.0
LAST_STOP_TIMEOUT = 90.0
RESTARTS = RestartPolicy(Backoff(first=0.5, longest=5.0), stable_s=10.0, max_ends=5)

T = TypeVar("T")


class Program:
    """A program of the demo.

    Attributes:
        stop_last: Other programs need it while they stop: it is stopped after them.
        restartable: It can be restarted while the others run.
        tail: The last lines that it printed.
        is_done: Its work is done: it may end while the others run.
    """

    def __init__(
        self,
        name: str,
        begin: Callable[[], Awaitable[Child]],
        show: Callable[[str], None],
        *,
        stop_last: bool,
        restartable: bool,
    ) -> None:
        self.name = name
        self.stop_last = stop_last
        self.restartable = restartable
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.keeper = Keeper(begin, self.add_line, RESTARTS)
        self.is_done = False
        self._lines: deque[str] = deque(maxlen=1000)
        self._printed = asyncio.Event()
        self._show = show

    @property
    def child(self) -> Child:
        """Its process; a new one after each restart."""
        assert self.keeper.child is not None, "it is started when it is made"
        return self.keeper.child

    def add_line(self, line: str) -> None:
        """Add a line that it printed."""
        self.tail.append(line)
        self._lines.append(line)
        self._printed.set()  # also if the line cannot be shown
        self._show(line)

    async def wait_line(self, start: str) -> str:
        """Wait for a line that begins with ``start``; return the rest of the newest such line."""
        while True:
            for line in reversed(self._lines):
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
            await finish(self._stop_all())  # a signal may cancel a run whose time is up
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
        again: Sequence[str] | None = None,
        again_after: str = "",
    ) -> Program:
        """Start a program.

        Args:
            name: Name in its log file and in messages.
            argv: Its command line.
            env: Environment variables to change.
            stop_last: Other programs need it while they stop: stop it after them.
            restartable: It can be restarted while the others run; see :meth:`enable_restarts`.
            again: Its command line when it is restarted; None: the same.
            again_after: Text of a line that it must have printed before; else its first command line counts.
        """
        first_done = asyncio.Event()
        log = (self._folder / f"{name}.log").open("a", encoding="utf-8", buffering=1)

        def show(line: str) -> None:
            log.write(f"{line}\n")
            self._show(f"[{name}] {line}")
            if again_after in line:
                first_done.set()

        async def begin() -> Child:
            words = again if again is not None and first_done.is_set() else argv
            return await Child.start(name, words, env=env)

        program = Program(name, begin, show, stop_last=stop_last, restartable=restartable)
        with contextlib.ExitStack() as stack:
            stack.enter_context(log)
            await program.keeper.start()
            self._programs.append(program)
            self._readers.create_task(self._supervise(program, stack.pop_all()), name=f"output of {name}")
        return program

    async def end(self, program: Program) -> None:
        """Stop a program whose work is done; the others go on."""
        program.is_done = True
        await program.keeper.stop(timeout=STOP_TIMEOUT)

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
            raise NotReadyError(f"{program.name} was not ready within {timeout:.0f} s{printed}") from None

    async def run_while_alive(self, work: Coroutine[Any, Any, T]) -> T:
        """Run ``work`` and return its result, as long as all programs run or are restarted.

        Raises:
            ProgramEndedError: A program ended and was not restarted; the work was cancelled.
        """
        task = asyncio.create_task(work)
        try:
            await asyncio.wait((task, self._failure), return_when=asyncio.FIRST_COMPLETED)
        finally:
            await cancel_and_wait(task)
        if self._failure.done():
            raise self._failure.result()
        return task.result()

    async def _supervise(self, program: Program, log: contextlib.ExitStack) -> None:
        """Log a program's output, and restart it if enabled."""

        def on_end(code: int, pause: float | None) -> bool:
            report = self._report_restart
            if self._failure.done() or report is None or not program.restartable or pause is None:
                return False
            report(f"{program.name} {describe_exit(code)}; restarting it")
            return True

        with log:
            try:
                code = await program.keeper.run(on_end)
            except OSError as error:  # a restart cannot be reported
                program.add_line(str(error))
                code = program.child.returncode or 0
        if not (program.is_done or self._stopping.done() or self._failure.done()):
            self._failure.set_result(ProgramEndedError(program.name, code, program.tail))

    async def _stop_all(self) -> None:
        async with asyncio.TaskGroup() as stops:
            for program in self._programs:
                if not program.stop_last:
                    stops.create_task(program.keeper.stop(timeout=STOP_TIMEOUT))
        for program in reversed(self._programs):
            if program.stop_last:
                await program.keeper.stop(timeout=LAST_STOP_TIMEOUT)
