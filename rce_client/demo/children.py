"""The programs of a demo: started, logged to files, watched, and ended together."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from rce.supervision.process import Child
from rce_client.demo.exceptions import ChildDiedError, NotReadyError

TAIL = 25
"""How many of the last lines of a program are kept to be shown."""
STOP_TIMEOUT = 15.0
NEEDED_STOP_TIMEOUT = 25.0
DRAIN_TIMEOUT = 1.0
"""How long the output of an ended program is read on; something that it started may hold it open."""

T = TypeVar("T")


class Program:
    """A running program of the demo."""

    def __init__(self, child: Child, log: Path, *, needed: bool) -> None:
        self.child = child
        self.log = log
        self.needed = needed
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
        self._death: asyncio.Future[ChildDiedError] = asyncio.get_running_loop().create_future()
        self._stopping = False

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
        self._stopping = True
        try:
            await self._stop_all()
        finally:
            await self._readers.__aexit__(None, None, None)

    async def start(
        self, name: str, argv: Sequence[str], *, env: Mapping[str, str] | None = None, needed: bool = False
    ) -> Program:
        """Start a program.

        Args:
            name: For its log and for people.
            argv: Its command line.
            env: What is different in its environment.
            needed: The others need it to take their leave: it is ended after them.
        """
        child = await Child.start(name, argv, env=env)
        program = Program(child, self._folder / f"{name}.log", needed=needed)
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
        """Run ``work`` for as long as all programs live.

        Raises:
            ChildDiedError: One ended; the work was cancelled.
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
        """Log what a program prints, and notice its end."""
        child = program.child
        reading = asyncio.create_task(self._log(program))
        try:
            code = await child.wait()
            await asyncio.wait((reading,), timeout=DRAIN_TIMEOUT)
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
        if not self._stopping and not self._death.done():
            self._death.set_result(ChildDiedError(child.name, code, program.tail))

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
