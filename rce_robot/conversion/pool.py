"""Shares a few worker processes among users: in turn, one job of a user at a time while others wait.

Processes start with the first job, and end after a time without jobs. A process that takes too long for a job
is killed.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.aio.tasks import BackgroundTasks
from rce_robot.conversion.process import WorkerProcess
from rce_robot.exceptions import ConversionFailedError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rce_robot.conversion.jobs import Job, Result
    from rce_robot.outgoing import Buffer

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConversionSettings:
    """The settings of conversions of large messages."""

    workers: int = max(2, min(3, (os.cpu_count() or 1) - 1))
    """Maximum number of processes. One user has one fewer, so that one remains for others."""
    memory: int = 512 << 20
    """Bytes that one process may use while it converts: the largest messages need about 300 MB."""
    timeout: float = 10.0
    """Seconds that one conversion may take."""
    idle: float = 10.0
    """Seconds without a conversion after which a process ends."""
    waiting: int = 64
    """Conversions of one user that may wait."""


@dataclass(eq=False, slots=True)
class _Order:
    user: str
    job: Job
    parts: Sequence[Buffer]
    answer: asyncio.Future[tuple[Result, list[memoryview]]]

    def refuse(self, _: object = None) -> None:
        """Tell the waiting caller that the pool is closed, if it has no answer yet."""
        if not self.answer.done():
            self.answer.set_exception(ConversionFailedError("the robot endpoint is shutting down"))


class ConversionPool:
    """The worker processes of an endpoint.

    Invariant: a user is in ``_waiting`` exactly while orders of theirs wait.

    Args:
        packages: Folders with packages that define messages.
        settings: The number of processes and their limits.

    Attributes:
        killed: How many conversions were given up because they took too long.
    """

    def __init__(
        self, packages: Sequence[Path] = (), settings: ConversionSettings = ConversionSettings()
    ) -> None:
        self._packages = packages
        self._settings = settings
        self._waiting: OrderedDict[str, deque[_Order]] = OrderedDict()
        self._running: Counter[str] = Counter()
        self._idle: dict[WorkerProcess, asyncio.TimerHandle] = {}
        self._count = 0
        self._alive: set[WorkerProcess] = set()
        """All processes whose end was not observed yet."""
        self._tasks = BackgroundTasks()
        self._closed = False
        self.killed = 0

    async def convert(self, user: str, job: Job, parts: Sequence[Buffer]) -> tuple[Result, list[memoryview]]:
        """Do a job when it is the user's turn. A job whose caller was cancelled is not begun.

        Args:
            user: The user of the message.
            job: The job.
            parts: The bytes that belong to it.

        Raises:
            ConversionFailedError: Too many of the user's jobs wait, or it took too long or too much memory.
        """
        if self._closed:
            raise ConversionFailedError("the robot endpoint is shutting down")
        orders = self._waiting.setdefault(user, deque())
        if len(orders) >= self._settings.waiting:
            raise ConversionFailedError(f"{len(orders)} large messages wait to be converted already")
        order = _Order(user, job, parts, asyncio.get_running_loop().create_future())
        orders.append(order)
        self._start_next()
        try:
            return await order.answer
        finally:
            self._withdraw(order)
            del order  # its error refers to this frame, and so to the message, until it is collected

    async def close(self) -> None:
        """End all processes; waiting jobs fail."""
        self._closed = True
        for orders in self._waiting.values():
            for order in orders:
                order.refuse()
        self._waiting.clear()
        for timer in self._idle.values():
            timer.cancel()
        self._idle.clear()
        await self._tasks.close()
        for worker in list(self._alive):  # those too whose end was cut short above
            await self._end(worker)

    def _withdraw(self, order: _Order) -> None:
        orders = self._waiting.get(order.user)
        if orders is not None and order in orders:
            orders.remove(order)
        if orders is not None and not orders:
            del self._waiting[order.user]

    def _start_next(self) -> None:
        """Begin as many jobs as possible."""
        while not self._closed and (order := self._next()) is not None:
            if self._idle:
                worker, timer = self._idle.popitem()
                timer.cancel()
            else:
                worker = WorkerProcess(self._packages, self._settings.memory)
                self._alive.add(worker)
                self._count += 1
            self._running[order.user] += 1
            task = self._tasks.spawn(self._serve(worker, order), name=f"conversion for {order.user}")
            task.add_done_callback(order.refuse)  # a task cancelled before its first step did not

    def _next(self) -> _Order | None:
        """Take the next order, user by user in turn."""
        if not self._idle and self._count >= self._settings.workers:
            return None
        for user in list(self._waiting):
            if self._running[user] < max(1, self._settings.workers - 1):
                orders = self._waiting[user]
                order = orders.popleft()
                self._waiting.move_to_end(user)
                if not orders:
                    del self._waiting[user]
                return order
        return None

    async def _serve(self, worker: WorkerProcess, order: _Order) -> None:
        """Do an order; afterwards the worker is idle or has ended."""
        sound = False
        try:
            result = await self._do(worker, order)
            sound = True
            if not order.answer.done():
                order.answer.set_result(result)
        except (ConversionFailedError, OSError) as error:
            if not order.answer.done():
                order.answer.set_exception(ConversionFailedError(str(error)))
        finally:
            order.refuse()
            self._running -= Counter([order.user])
            if sound and not self._closed:
                loop = asyncio.get_running_loop()
                self._idle[worker] = loop.call_later(self._settings.idle, self._retire, worker)
            else:
                self._count -= 1
                await self._end(worker)
            self._start_next()

    async def _do(self, worker: WorkerProcess, order: _Order) -> tuple[Result, list[memoryview]]:
        if not worker.pid:
            await worker.start()
        try:
            async with asyncio.timeout(self._settings.timeout):
                return await worker.do(order.job, order.parts)
        except TimeoutError as error:
            self.killed += 1
            _log.warning("user %s: a conversion was given up after %g s", order.user, self._settings.timeout)
            raise ConversionFailedError(
                f"converting the message takes more than {self._settings.timeout:g} s"
            ) from error

    def _retire(self, worker: WorkerProcess) -> None:
        """End a process that had no job for a while."""
        if self._idle.pop(worker, None) is not None:
            self._count -= 1
            self._tasks.spawn(self._end(worker), name="end of an idle converter")

    async def _end(self, worker: WorkerProcess) -> None:
        await worker.end()
        self._alive.discard(worker)
