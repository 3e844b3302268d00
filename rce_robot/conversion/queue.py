"""The conversions of one interface that are left to other processes: in order, and not many."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from rce.guard.holdings import Holding

Out = TypeVar("Out")

MAX_WAITING = 4
"""Messages that wait for their conversion; more would only grow old."""


class QueueOwner(Protocol):
    """What a queue needs of the robot it belongs to."""

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run something until the robot leaves; False (and nothing done) if too much runs already."""

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
    """The conversions of one interface in one direction. The oldest that waits gives way to a new one.

    Args:
        owner: The robot.
        deliver: Called with what each conversion returned, in order.
        dropped: Called for each message that is thrown away because memory is short.
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
        """Whether something is being converted: what comes now must wait, so that it stays in order."""
        return self._run != 0

    def put(self, size: int, work: Callable[[], Awaitable[Out]]) -> bool:
        """Add a conversion.

        Args:
            size: Bytes that it holds.
            work: Does it; must not raise.

        Returns:
            False if a message had to be thrown away for it, or if it was itself.
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
        """Forget what waits, because what ran has ended with the robot's connection."""
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
