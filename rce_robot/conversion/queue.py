"""A short, ordered queue of the conversions of one interface in other processes."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from rce.aio.queues import BoundedQueue

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Hashable

    from rce.guard import Holding

Out = TypeVar("Out")

MAX_WAITING = 4
"""Messages without a key that wait for their conversion; more would only become stale."""


class QueueOwner(Protocol):
    """The interface of a queue to its robot."""

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run a coroutine until the robot leaves; return False (without effect) if too many run already."""

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        """Count bytes that are held; see :class:`rce.guard.holdings.Holdings`."""


class _Entry(Generic[Out]):
    """A conversion that waits or runs."""

    __slots__ = ("holding", "key", "shared", "size", "work")

    def __init__(self, size: int, work: Callable[[], Awaitable[Out]], key: Hashable, *, shared: bool) -> None:
        self.size = size
        self.work = work
        self.key = key
        self.shared = shared
        self.holding: Holding | None = None

    def release(self) -> None:
        if self.holding is not None:
            self.holding.release()


class ConversionQueue(Generic[Out]):
    """The conversions of one interface in one direction. If the queue is full, a new one replaces the oldest.

    A conversion with a *key*, such as the source of a latched message, is kept until one with the same key
    comes, and takes no room; see :class:`rce.aio.queues.BoundedQueue`.

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
        self._waiting = BoundedQueue[_Entry[Out]](MAX_WAITING, sys.maxsize, on_drop=self._replace)
        self._running: _Entry[Out] | None = None
        self._run = 0
        """Counts the runs; 0 while nothing runs."""
        self._runs = 0
        self._replaced = 0

    @property
    def busy(self) -> bool:
        """Whether a conversion runs: new messages must wait, to keep the order."""
        return self._run != 0

    def put(
        self, size: int, work: Callable[[], Awaitable[Out]], key: Hashable = None, *, shared: bool = False
    ) -> bool:
        """Add a conversion.

        Args:
            size: Bytes that it holds; 0 if it holds no message, and may be dropped silently.
            work: Does it; must not raise.
            key: Keeps it until a newer one with this key comes; None: it may be dropped.
            shared: Whether its bytes are held and counted elsewhere until :meth:`count` or :meth:`drop`.

        Returns:
            False if another message was dropped for it, or this one was dropped.
        """
        before = self._replaced
        entry = _Entry(size, work, key, shared=shared)
        self._waiting.put(entry, size, key)
        if not self.busy:
            self._runs += 1
            self._run = self._runs
            if not self._owner.run(self._convey(self._run)):
                self._run = 0
                self._waiting.clear()
                return False
        if size and not shared:
            self._hold(entry)
        return self._replaced == before

    def count(self, key: Hashable) -> None:
        """Count the bytes of shared conversions with a key, which only they hold now."""
        for entry in (self._running, *self._waiting):
            if entry is not None and entry.shared and entry.key == key:
                entry.shared = False
                self._hold(entry)

    def drop(self, key: Hashable) -> None:
        """Drop the waiting shared conversion with a key."""
        self._waiting.remove(lambda entry: entry.shared and entry.key == key)

    def clear(self) -> None:
        """Drop the waiting conversions, because the running one has ended with the robot's connection."""
        for entry in self._waiting:
            entry.release()
        self._waiting.clear()
        self._run = 0

    def _hold(self, entry: _Entry[Out]) -> None:
        entry.holding = self._owner.hold(entry.size, lambda: self._give_up(entry))
        if entry is not self._running and entry not in self._waiting:  # it was given up at once
            entry.release()

    def _replace(self, entry: _Entry[Out]) -> None:
        entry.release()
        self._replaced += bool(entry.size)

    def _give_up(self, entry: _Entry[Out]) -> None:
        if self._waiting.remove(lambda waiting: waiting is entry):
            self._dropped()

    async def _convey(self, run: int) -> None:
        try:
            while self._run == run and self._waiting:
                self._running = entry = self._waiting.take()
                try:
                    converted = await entry.work()
                finally:
                    entry.release()
                    if self._running is entry:
                        self._running = None
                if self._run == run:
                    self._deliver(converted)
        finally:
            if self._run == run:
                self.clear()
