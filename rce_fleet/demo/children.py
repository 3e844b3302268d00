"""The programs of a demo: started, logged to files, watched, and ended together."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias, TypeVar

from rce.supervision.process import Child
from rce_fleet.demo.exceptions import ChildDiedError, NotReadyError, end_of

TAIL = 25
"""How many of the last lines of a program are kept to be shown."""
STOP_TIMEOUT = 15.0
NEEDED_STOP_TIMEOUT = 90.0
DRAIN_TIMEOUT = 1.0
"""How long the output of an ended program is read on; something that it started may hold it open."""

LIFE_LEAST = 10.0
"""A program that ran for so long is well: if it ends, it may be started again as often as a new one."""
DEATHS_MOST = 5
REVIVAL_FIRST, REVIVAL_MOST = 0.5, 5.0
"""Seconds before a program is started again, the first time and at the most."""

T = TypeVar("T")
Again: TypeAlias = Callable[[], Coroutine[Any, Any, Child]]
"""Starts a program once more."""


class Program:
    """A program of the demo.

    Attributes:
        child: Its process; another one after it was started again.
        needed: The others need it to take their leave.
        revivable: It can be started again while the others go on.
    """

    def __init__(self, child: Child, log: Path, again: Again, *, needed: bool, revivable: bool) -> None:
        self.child = child
        self.log = log
        self.again = again
        self.needed = needed
        self.revivable = revivable
        self.deaths = 0
        """How often in a row it ended soon after its start."""
        self.tail: deque[str] = deque(maxlen=TAIL)
        self.lines: deque[str] = deque(maxlen=1000)
        self._printed = asyncio.Event()

    def put(self, line: str) -> None:
        """Take a line that it printed."""
        self.tail.append(line)
        self.lines.append(line)
        self._printed.set()

    async def wait_line(self, start: str) -> str:
        """Wait for a line that begins with ``start``; returns the rest of it."""
        while True:
            for line in self.lines:
                if line.startswith(start):
                    return line[len(start) :].strip()
            self._printed.clear()
            await self._printed.wait()


class Children:
    """Programs that belong together. An async context manager; leaving it ends them all.

    Those that the others need to take their leave are ended last.

    Args:
        folder: Where each program's output goes to, ``NAME.log``.
        show: Gets every line that a program prints.
    """

    def __init__(self, folder: Path, show: Callable[[str], None]) -> None:
        self._folder = folder
        self._show = show
        self._programs: list[Program] = []
        self._readers = asyncio.TaskGroup()
        self._tell: Callable[[str], None] | None = None
        self._death: asyncio.Future[ChildDiedError] = asyncio.get_running_loop().create_future()
        self._leaving: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done as soon as all are ended."""

    @property
    def programs(self) -> tuple[Program, ...]:
        """All programs, in the order in which they were started."""
        return tuple(self._programs)

    async def __aenter__(self) -> Self:
        await self._readers.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leaving.set_result(None)
        try:
            await self._stop_all()
        finally:
            await self._readers.__aexit__(None, None, None)

    def revive(self, tell: Callable[[str], None]) -> None:
        """From now on start programs again that can be, when they end; ``tell`` gets lines for people."""
        self._tell = tell

    async def start(
        self,
        name: str,
        argv: Sequence[str],
        *,
        env: Mapping[str, str] | None = None,
        needed: bool = False,
        revivable: bool = False,
    ) -> Program:
        """Start a program.

        Args:
            name: For its log and for people.
            argv: Its command line.
            env: What is different in its environment.
            needed: The others need it to take their leave: it is ended after them.
            revivable: It can be started again while the others go on; see :meth:`revive`.
        """

        async def again() -> Child:
            return await Child.start(name, argv, env=env)

        log = self._folder / f"{name}.log"
        program = Program(await again(), log, again, needed=needed, revivable=revivable)
        self._programs.append(program)
        self._readers.create_task(self._attend(program), name=f"output of {name}")
        return program

    async def wait_line(self, program: Program, start: str, timeout: float) -> str:
        """Wait until a program prints a line that begins with ``start``; returns the rest of it.

        Raises:
            NotReadyError: It did not, in ``timeout`` seconds.
        """
        try:
            async with asyncio.timeout(timeout):
                return await program.wait_line(start)
        except TimeoutError:
            said = "".join(f"\n    {line}" for line in program.tail)
            raise NotReadyError(f"{program.child.name} was not ready within {timeout:.0f} s{said}") from None

    async def while_alive(self, work: Coroutine[Any, Any, T]) -> T:
        """Run ``work`` for as long as all programs live, or are started again.

        Raises:
            ChildDiedError: One ended for good; the work was cancelled.
        """
        task = asyncio.create_task(work)
        try:
            await asyncio.wait((task, self._death), return_when=asyncio.FIRST_COMPLETED)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        if self._death.done():
            raise self._death.result()
        return task.result()

    async def _attend(self, program: Program) -> None:
        """Watch a program, and start it again if that is wanted."""
        while True:
            code = await self._watch(program)
            if not await self._revived(program, code):
                if not self._leaving.done() and not self._death.done():
                    self._death.set_result(ChildDiedError(program.child.name, code, program.tail))
                return

    async def _revived(self, program: Program, code: int) -> bool:
        """Start a program again that ended; False if it stays dead."""
        over = self._leaving.done() or self._death.done()
        if over or self._tell is None or not program.revivable or program.deaths >= DEATHS_MOST:
            return False
        pause = min(REVIVAL_MOST, REVIVAL_FIRST * 2 ** (program.deaths - 1))
        self._tell(f"{program.child.name} {end_of(code)}; it is started again")
        await asyncio.wait((self._leaving,), timeout=pause)
        if self._leaving.done():
            return False
        try:
            program.child = await program.again()
        except OSError as error:
            program.put(str(error))
            return False
        if self._leaving.done():
            await program.child.stop(timeout=STOP_TIMEOUT)
        return True

    async def _watch(self, program: Program) -> int:
        """Log what a program prints until its end; return its exit code."""
        child, started = program.child, asyncio.get_running_loop().time()
        reading = asyncio.create_task(self._log(program))
        try:
            code = await child.wait()
            await asyncio.wait((reading,), timeout=DRAIN_TIMEOUT)
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
        lived = asyncio.get_running_loop().time() - started
        program.deaths = program.deaths + 1 if lived < LIFE_LEAST else 1
        return code

    async def _log(self, program: Program) -> None:
        with program.log.open("a", encoding="utf-8", buffering=1) as log:
            async for line in program.child.lines():
                log.write(f"{line}\n")
                program.put(line)
                self._show(f"[{program.child.name}] {line}")

    async def _stop_all(self) -> None:
        async with asyncio.TaskGroup() as group:
            for program in self._programs:
                if not program.needed:
                    group.create_task(program.child.stop(timeout=STOP_TIMEOUT))
        for program in reversed(self._programs):
            if program.needed:
                await program.child.stop(timeout=NEEDED_STOP_TIMEOUT)
