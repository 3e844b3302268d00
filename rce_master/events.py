"""Recent events: a ring buffer of numbered events that clients can follow and resume."""

from __future__ import annotations

import asyncio
import contextlib
from bisect import bisect_right
from operator import attrgetter
from typing import TYPE_CHECKING

from msgspec import Struct

from rce_master.state.changes import USER_ADDED, USER_REMOVED

if TYPE_CHECKING:
    from rce_master.state.changes import StateEvent

CAPACITY = 10_000
IDS_OF_TERM = 10**10
_FIRST_TERM = 1000
"""So many terms are counted before the first one: its ids are greater than milliseconds since 1970."""
GAP = "gap"
"""Kind of an event that stands for those that a follower missed."""
AT_ONCE = 100
"""Events that a follower gets at a time."""
_COMPACT_AFTER = 64
"""Forgotten events after which a list may be made shorter."""
_ID = attrgetter("id")


class Event(Struct, frozen=True, kw_only=True):
    """An event."""

    id: int
    """Increases by one; by more across a restart."""
    time: float
    """Seconds since 1970."""
    kind: str
    """Such as ``robot_connected`` or ``node_failed``."""
    user: str
    """The owner; empty: for administrators only."""
    subject: str
    """The object of the event, such as ``user/container/node``."""
    text: str = ""


class _UserLog:
    """A user's events, oldest first. Finding one by its id takes a few steps, not one for each event."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._begin = 0
        self.forgotten = -1
        """Id of the newest event that was dropped."""

    def __len__(self) -> int:
        return len(self._events) - self._begin

    def append(self, event: Event) -> None:
        """Add the newest event."""
        self._events.append(event)

    def forget_oldest(self) -> None:
        """Drop the oldest event."""
        self.forgotten = self._events[self._begin].id
        self._begin += 1
        if self._begin > max(_COMPACT_AFTER, len(self)):
            del self._events[: self._begin]
            self._begin = 0

    def since(self, id_: int, limit: int) -> list[Event]:
        """Return at most ``limit`` events after an event, oldest first."""
        first = bisect_right(self._events, id_, lo=self._begin, key=_ID)
        return self._events[first : first + limit]


class EventLog:
    """Keeps the newest events. Followers read from the ring, so a slow one costs no memory.

    Args:
        start: Seconds since 1970. Event ids start at its milliseconds: so they increase across a restart, as
            long as fewer than a thousand events a second happen on average.
        capacity: How many events are kept.
        term: Of the leadership, if other masters may lead: event ids start at a number of their own for each
            term, since the clocks of machines differ. 0: there are no others.

    Attributes:
        is_closed: Whether followers are to end, because this master ends.
    """

    def __init__(self, start: float, capacity: int = CAPACITY, *, term: int = 0) -> None:
        self._events: dict[str, _UserLog] = {}
        """By user."""
        self._made: dict[str, int] = {}
        """Ids of the events with which users were made, by user."""
        self._count = 0
        self._capacity = capacity
        self._first_id = (_FIRST_TERM + term) * IDS_OF_TERM if term else int(start * 1000)
        self._next_id = self._first_id
        self._news = asyncio.Event()
        self.is_closed = False

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
        if event.kind == USER_ADDED:
            self._made[event.subject] = event.id
        elif event.kind == USER_REMOVED:
            self._made.pop(event.subject, None)
        self._events.setdefault(event.user, _UserLog()).append(event)
        self._count += 1
        if self._count > self._capacity:
            self._forget_one()
        self.wake()

    def _forget_one(self) -> None:
        """Drop the oldest event of the user with the most events, so that a flood does not affect others."""
        user = max(self._events, key=lambda user: len(self._events[user]))
        self._events[user].forget_oldest()
        self._count -= 1

    def missed(self, id_: int, user: str | None = None) -> int | None:
        """Return where a follower who resumes after an event goes on; None if no event is missing.

        Args:
            id_: The event, which may be one of the time before this master started or led, also a greater
                one: the engine had another store then, or its clock was set back.
            user: Of this user only; None: of all.
        """
        logs = self._events.values() if user is None else filter(None, [self._events.get(user)])
        start = self._first_id - 1
        if id_ > self.last_id:
            return start
        forgotten = max((log.forgotten for log in logs), default=start)
        return max(id_, start) if id_ < max(start, forgotten) else None

    def made(self, user: str) -> int:
        """Return after which event those of a user begin: earlier ones are of a former user of that name.

        Times do not tell it: the clock may have been set back since the user was made.
        """
        return self._made.get(user, 0)

    def wake(self) -> None:
        """Wake all followers, so that they check whether they may still follow."""
        self._news.set()
        self._news = asyncio.Event()

    def close(self) -> None:
        """Have all followers end, and those that come later."""
        self.is_closed = True
        self.wake()

    async def wait_change(self, timeout: float) -> None:
        """Wait for an event or a call of :meth:`wake`, at most ``timeout`` seconds; not once closed."""
        if self.is_closed:
            return
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._news.wait()

    def since(self, id_: int, limit: int = CAPACITY, user: str | None = None) -> list[Event]:
        """Return the events after an event, oldest first.

        Args:
            id_: The event.
            limit: At most so many.
            user: Of this user only; None: of all.
        """
        if id_ >= self.last_id:
            return []
        if user is not None:
            return self._events[user].since(id_, limit) if user in self._events else []
        found = [event for log in self._events.values() for event in log.since(id_, limit)]
        return sorted(found, key=_ID)[:limit]

    async def wait(self, id_: int, timeout: float, user: str | None = None) -> list[Event]:
        """Wait for events after an event.

        A follower that is slower than events are dropped misses some.

        Args:
            id_: The event.
            timeout: Seconds.
            user: Of this user only; None: of all.

        Returns:
            At most :data:`AT_ONCE` events, oldest first; none if none came within ``timeout`` seconds, or if
            the right to follow may have changed.
        """
        found = self.since(id_, AT_ONCE, user)
        if found:
            return found
        await self.wait_change(timeout)
        return self.since(id_, AT_ONCE, user)
