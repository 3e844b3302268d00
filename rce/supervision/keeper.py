"""One child program that is kept running: its output is read, and it is started again when it ends.

For programs that run on their own: those of ``rce up`` and of the demo. A process that answers requests is
started by the next request, and has an owner that knows its protocol: converters
(``rce_robot.conversion.pool``), the fork server (``rce_container.forkserver.process``) and the plan worker
(``rce_fleet.nodes.plan_worker``). pip runs once for each package, within a time and a size.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.aio.tasks import cancel_and_wait

if TYPE_CHECKING:
    from rce.aio.backoff import Backoff
    from rce.supervision.process import Child

OUTPUT_TIMEOUT_S = 1.0
"""How long the output of an ended program is still read; a process that it started may hold it open."""


@dataclass(frozen=True, slots=True)
class RestartPolicy:
    """When a program that ended is started again."""

    backoff: Backoff
    """Pauses before each start."""
    stable_s: float
    """Seconds after which a running program counts as stable: the count of its ends restarts."""
    max_ends: int = 0
    """After so many ends in a row it is not started again; 0: no limit."""


class Keeper:
    """Keeps one program running, until it is stopped or ends for good.

    Args:
        begin: Starts a process of the program; raises :class:`OSError` if that is not possible.
        take_line: Gets every line that it prints. A line is lost if this raises :class:`OSError`.
        policy: When it is started again.

    Attributes:
        child: The newest process; None before the first.

    Example:
        >>> keeper = Keeper(lambda: Child.start("sleeper", ["sleep", "5"]), print, policy)
        >>> await keeper.run(lambda code, pause: pause is not None)
    """

    def __init__(
        self, begin: Callable[[], Awaitable[Child]], take_line: Callable[[str], None], policy: RestartPolicy
    ) -> None:
        self.child: Child | None = None
        self._begin = begin
        self._take_line = take_line
        self._policy = policy
        self._ends = 0
        self._stopping = asyncio.Event()

    async def start(self) -> Child:
        """Start a process without waiting for its end; then call :meth:`run`.

        Raises:
            OSError: That is not possible.
        """
        self.child = await self._begin()
        return self.child

    async def run(self, on_end: Callable[[int, float | None], bool]) -> int:
        """Keep the program running. An error of a later start counts as one more end.

        A process that :meth:`start` started is the first one. The end of this call, also by cancellation or
        an error of ``on_end``, ends the process.

        Args:
            on_end: Called with the exit code of each process that ended by itself, and with the pause before
                the next in seconds; None if the policy allows no other one. Tells whether to start it again.

        Returns:
            The exit code of the last process.

        Raises:
            OSError: Its first process cannot be started.
        """
        loop = asyncio.get_running_loop()
        child: Child | None = self.child or await self.start()
        code = 0
        while child is not None:
            started = loop.time()
            code = await self._run_once(child)
            if self._stopping.is_set():
                break
            pause = self._next_pause(loop.time() - started)
            child = await self._start_again(pause) if on_end(code, pause) else None
        return code

    async def stop(self, *, timeout: float) -> None:
        """End the program, and do not start it again. :meth:`run` then returns.

        Args:
            timeout: Seconds from SIGTERM to SIGKILL.
        """
        self._stopping.set()
        if self.child is not None:
            await self.child.stop(timeout=timeout)

    def _next_pause(self, uptime: float) -> float | None:
        self._ends = self._ends + 1 if uptime < self._policy.stable_s else 1
        if self._policy.max_ends and self._ends >= self._policy.max_ends:
            return None
        return self._policy.backoff.pause_after(self._ends)

    async def _start_again(self, pause: float | None) -> Child | None:
        """Start a process after a pause; return None if it is stopped or has failed too often."""
        while pause is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._stopping.wait()
            if self._stopping.is_set():
                break
            try:
                return await self.start()
            except OSError as error:  # memory or processes are exhausted for a while
                self._show(f"(it cannot be started: {error})")
                pause = self._next_pause(0.0)
        return None

    async def _run_once(self, child: Child) -> int:
        reading = asyncio.create_task(self._read(child))
        try:
            if self._stopping.is_set():  # stop was called while the process was being started
                await child.stop()
            return await child.wait()
        finally:
            await child.stop()
            await asyncio.wait((reading,), timeout=OUTPUT_TIMEOUT_S)
            await cancel_and_wait(reading)

    async def _read(self, child: Child) -> None:
        async for line in child.lines():
            self._show(line)

    def _show(self, line: str) -> None:
        with contextlib.suppress(OSError):  # a full disk: the program would block with its output not read
            self._take_line(line)
