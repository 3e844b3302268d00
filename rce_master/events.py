"""What happened lately: a ring of numbered events that can be followed and resumed."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from itertools import takewhile
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from rce_master.state.changes import StateEvent

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
        self._events: dict[str, deque[Event]] = {}
        """By user."""
        self._count = 0
        self._capacity = capacity
        self._next_id = int(start * 1000)
        self._news = asyncio.Event()

    @property
    def last_id(self) -> int:
        """Id of the newest event."""
        return self._next_id - 1

    def add(self, state_event: StateEvent, time: float) -> None:
        """Add an event and wake all followers."""
        event = Event(
            id=self._next_id,
            time=time,
            kind=state_event.kind,
            user=state_event.user,
            subject=state_event.subject,
            text=state_event.text,
        )
        self._next_id += 1
        self._events.setdefault(event.user, deque()).append(event)
        self._count += 1
        if self._count > self._capacity:
            self._forget_one()
        self.wake()

    def _forget_one(self) -> None:
        """Forget the oldest event of the user who has the most: nobody's flood costs others theirs."""
        user = max(self._events, key=lambda user: len(self._events[user]))
        self._events[user].popleft()
        self._count -= 1

    def wake(self) -> None:
        """Wake all followers, to see whether they may still follow."""
        self._news.set()
        self._news = asyncio.Event()

    async def wait_change(self, timeout: float) -> None:
        """Wait for an event or a call of :meth:`wake`, at most ``timeout`` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._news.wait()

    def since(self, id_: int, limit: int = CAPACITY, user: str | None = None) -> list[Event]:
        """List what came after an event, oldest first.

        Args:
            id_: The event.
            limit: At most so many.
            user: Of this user only; None: of all.
        """
        if id_ >= self.last_id:
            return []
        logs = self._events.values() if user is None else [self._events.get(user, deque())]
        found = [event for log in logs for event in takewhile(lambda event: event.id > id_, reversed(log))]
        return sorted(found, key=lambda event: event.id)[:limit]

    async def wait(self, id_: int, timeout: float, user: str | None = None) -> list[Event]:
        """Wait for what comes after an event.

        A follower who is slower than events are forgotten misses some.

        Args:
            id_: The event.
            timeout: Seconds.
            user: Of this user only; None: of all.

        Returns:
            At most a hundred events, oldest first; none if nothing came within ``timeout`` seconds, or others
            of them may follow now than before.
        """
        if not self.since(id_, limit=1, user=user):
            await self.wait_change(timeout)
        return self.since(id_, limit=100, user=user)
