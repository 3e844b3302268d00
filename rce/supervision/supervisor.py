"""Keeps programs running: starts them in order, restarts one that dies, ends all in reverse order."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping, Sequence
from typing import Any

from rce.aio.backoff import Backoff
from rce.supervision.final import FinalCommand
from rce.supervision.keeper import Keeper, RestartPolicy
from rce.supervision.plan import Program
from rce.supervision.prefork import ForkedProcess, Prepared
from rce.supervision.process import Child

RESTARTS = RestartPolicy(Backoff(first=0.2, longest=5.0), stable_s=10.0)
READY_TIMEOUT_S = 60.0
_LOOK_AGAIN_S = 1.0


class StartError(Exception):
    """A program did not come up."""


class Supervisor:
    """Runs programs until it is cancelled.

    Args:
        programs: In the order in which they start.
        show: Gets every line they print.
        prepared: Forks for the first start of some of them, by their names.
    """

    def __init__(
        self,
        programs: Sequence[Program],
        show: Callable[[str], None],
        prepared: Mapping[str, Prepared] | None = None,
    ) -> None:
        self._programs = programs
        self._show = show
        self._prepared = dict(prepared or {})
        self._keepers: dict[str, Keeper] = {}
        """By the program's name."""
        self._finals: dict[str, FinalCommand] = {}

    def hurry(self) -> None:
        """Tell the programs that the user wants them to end at once."""
        for child in self._children():
            child.hurry()

    def drop_unused(self) -> None:
        """End the forks whose programs have not been started. Blocks for a moment."""
        while self._prepared:
            self._prepared.popitem()[1].drop()

    async def run(self, on_ready: Callable[[], None]) -> None:
        """Start all programs, call ``on_ready`` once all are up, and keep them up until cancelled.

        Raises:
            StartError: A program ended, or was not ready in time, at the first start.
        """
        try:
            async with asyncio.TaskGroup() as group:
                keepers: list[tuple[asyncio.Task[None], asyncio.Event]] = []
                try:
                    for program in self._programs:
                        ready = asyncio.Event()
                        task = group.create_task(self._keep(program, ready), name=program.name)
                        keepers.append((task, ready))
                        await self._until_ready(program, ready)
                        await self._arm(program)
                    on_ready()
                    await asyncio.Event().wait()
                finally:
                    await _to_its_end(_end([task for task, _ in keepers]))
        finally:
            await _to_its_end(self._end_finally())

    def _children(self) -> list[Child]:
        """Return the last process of each program."""
        return [keeper.child for keeper in self._keepers.values() if keeper.child is not None]

    async def _until_ready(self, program: Program, ready: asyncio.Event) -> None:
        try:
            async with asyncio.timeout(READY_TIMEOUT_S):
                await ready.wait()
        except TimeoutError:
            raise StartError(f"{program.name} was not ready within {READY_TIMEOUT_S:.0f} s") from None

    async def _arm(self, program: Program) -> None:
        if program.final:
            self._finals[program.name] = await FinalCommand.arm(program.final)

    async def _end_finally(self) -> None:
        """Clean up after programs that did not end properly.

        One may have been killed before, and the next may have ended before it cleaned up after the first one.
        """
        is_clean = not any(child.returncode for child in self._children())
        for name, final in self._finals.items():
            if is_clean:
                await final.disarm()
            elif code := await final.run():
                self._show(f"[up] what {name} left could not be removed: exit code {code}")

    async def _keep(self, program: Program, ready: asyncio.Event) -> None:
        def take_line(line: str) -> None:
            self._show(f"[{program.name}] {line}")
            if program.ready in line:
                ready.set()

        def on_end(code: int, pause: float | None) -> bool:
            if not ready.is_set():
                raise StartError(f"{program.name} ended with exit code {code} before it was ready")
            assert pause is not None, "the policy has no last end"
            self._show(f"[up] {program.name} ended with exit code {code}; starting it again in {pause:.1f} s")
            return True

        keeper = self._keepers[program.name] = Keeper(lambda: self._start(program), take_line, RESTARTS)
        await keeper.run(on_end)

    async def _start(self, program: Program) -> Child:
        prepared = self._prepared.pop(program.name, None)
        if prepared is None:
            return await Child.start(program.name, program.argv, env=program.env)
        return Child(program.name, await ForkedProcess.begin(prepared))


async def _end(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancel tasks one after the other, the last one first."""
    for task in reversed(tasks):
        while not task.done():
            if not task.cancelling():  # a second cancellation would interrupt the end of its program
                task.cancel()
            # Of a timeout that ends in a task, the task says for a moment that it is being cancelled.
            await asyncio.wait([task], timeout=_LOOK_AGAIN_S)


async def _to_its_end(work: Coroutine[Any, Any, None]) -> None:
    """Run something to its end, however often this is cancelled meanwhile."""
    task = asyncio.create_task(work)
    cancelled = False
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            cancelled = True
    task.result()
    if cancelled:
        raise asyncio.CancelledError
