"""A short, ordered queue of the conversions of one interface in other processes."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from rce.guard import Holding

Out = TypeVar("Out")

MAX_WAITING = 4
"""Messages that wait for their conversion; more would only become stale."""


class QueueOwner(Protocol):
    """The interface of a queue to its robot."""

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run a coroutine until the robot leaves; return False (without effect) if too many run already."""

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        """Count bytes that are held; see :class:`rce.guard.holdings.Holdings`."""


class _Entry(Generic[Out]):
    """A conversion that waits or runs."""

    __slots__ = ("holding", "work")

    def __init__(self, work: Callable[[], Awaitable[Out]]) -> None:
        self.work = work
        self.holding: Holding | None = None

    def release(self) -> None:
        if self.holding is not None:
            self.holding.release()


class ConversionQueue(Generic[Out]):
    """The conversions of one interface in one direction. If the queue is full, a new one replaces the oldest.

    Args:
        owner: The robot.
        deliver: Called with the result of each conversion, in order.
        dropped: Called for each message that is dropped because memory is short.
    """

    def __init__(
        self, owner: QueueOwner, deliver: Callable[[Out], None], dropped: Callable[[], None]
    ) -> None:
        self._owner = owner
        self._deliver = deliver
        self._dropped = dropped
        self._waiting: deque[_Entry[Out]] = deque()
        self._run = 0
        """Counts the runs; 0 while nothing runs."""
        self._runs = 0

    @property
    def busy(self) -> bool:
        """Whether a conversion runs: new messages must wait, to keep the order."""
        return self._run != 0

    def put(self, size: int, work: Callable[[], Awaitable[Out]]) -> bool:
        """Add a conversion.

        Args:
            size: Bytes that it holds.
            work: Does it; must not raise.

        Returns:
            False if another message was dropped for it, or this one was dropped.
        """
        room = len(self._waiting) < MAX_WAITING
        if not room:
            self._waiting.popleft().release()
        entry = _Entry(work)
        self._waiting.append(entry)
        if not self.busy:
            self._runs += 1
            self._run = self._runs
            if not self._owner.run(self._convey(self._run)):
                self._run = 0
                self._waiting.clear()
                return False
        entry.holding = self._owner.hold(size, lambda: self._give_up(entry))
        if entry not in self._waiting:
            entry.release()
        return room

    def clear(self) -> None:
        """Drop the waiting conversions, because the running one has ended with the robot's connection."""
        for entry in self._waiting:
            entry.release()
        self._waiting.clear()
        self._run = 0

    def _give_up(self, entry: _Entry[Out]) -> None:
        if entry in self._waiting:
            self._waiting.remove(entry)
            self._dropped()

    async def _convey(self, run: int) -> None:
        try:
            while self._run == run and self._waiting:
                entry = self._waiting.popleft()
                try:
                    converted = await entry.work()
                finally:
                    entry.release()
                if self._run == run:
                    self._deliver(converted)
        finally:
            if self._run == run:
                self.clear()
