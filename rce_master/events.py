"""What happened lately: a ring of numbered events that can be followed and resumed."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from rce_master.state.changes import Happening

CAPACITY = 10_000


class Event(Struct, frozen=True, kw_only=True):
    """Something that happened."""

    id: int
    """Grows by one, also over a restart (by more then)."""
    time: float
    """Seconds since 1970."""
    kind: str
    """Such as ``robot_connected`` or ``node_failed``."""
    user: str
    """Whose it is; empty: of interest to administrators only."""
    subject: str
    """What it is about, such as ``user/container/node``."""
    text: str = ""


class EventLog:
    """Keeps the newest events. Followers read from the ring, so a slow one costs no memory.

    Args:
        start: Seconds since 1970. Event ids start at its milliseconds: so they grow over a restart, as long
            as fewer than a thousand events a second happen on average.
        capacity: How many events are kept.
    """

    def __init__(self, start: float, capacity: int = CAPACITY) -> None:
        self._events: deque[Event] = deque(maxlen=capacity)
        self._next_id = int(start * 1000)
        self._news = asyncio.Event()

    @property
    def last_id(self) -> int:
        """Id of the newest event."""
        return self._next_id - 1

    def add(self, happening: Happening, time: float) -> None:
        """Add an event and wake all followers."""
        event = Event(
            id=self._next_id,
            time=time,
            kind=happening.kind,
            user=happening.user,
            subject=happening.subject,
            text=happening.text,
        )
        self._next_id += 1
        self._events.append(event)
        self.wake()

    def wake(self) -> None:
        """Wake all followers, to see whether they may still follow."""
        self._news.set()
        self._news = asyncio.Event()

    async def wait_change(self, timeout: float) -> None:
        """Wait for an event or a call of :meth:`wake`, at most ``timeout`` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._news.wait()

    def since(self, id_: int, limit: int = CAPACITY) -> list[Event]:
        """List what came after an event, oldest first."""
        if not self._events or id_ >= self.last_id:
            return []
        skip = max(0, id_ + 1 - self._events[0].id)
        return list(islice(self._events, skip, skip + limit))

    async def wait(self, id_: int, timeout: float) -> list[Event]:
        """Wait for what comes after an event.

        A follower that is slower than the ring turns misses events; their ids are missing then.

        Returns:
            At most a hundred events, oldest first; none if nothing came within ``timeout`` seconds.
        """
        if not self.since(id_, limit=1):
            await self.wait_change(timeout)
        return self.since(id_, limit=100)
