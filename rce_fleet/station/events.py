"""The fleet manager's events at the station: one subscription for all clients, gaps filled by requests."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError

KEPT = 2000
"""Newest events that are kept here, so that clients which follow cost the manager nothing."""
PAGE = 500
RECHECK_S = 15.0
"""After so long without an event the manager is asked: a message of the topic may have been lost."""

FleetEvent: TypeAlias = dict[str, Any]


@dataclass(frozen=True, slots=True)
class EventBatch:
    """Events that the manager returned.

    Attributes:
        events: The oldest first.
        journal: Which journal numbers them.
        newest: Number of the newest event of this journal.
    """

    events: Sequence[FleetEvent]
    journal: str
    newest: int


Ask: TypeAlias = Callable[[int, int], Awaitable[EventBatch]]
"""Returns events after a number, at most so many."""


def _ignore() -> None:
    pass


class EventFeed:
    """The newest events, and the way to older ones.

    Args:
        ask: Asks the manager.

    Attributes:
        newest: Number of the newest event that was seen on the topic; None before the first one.
        journal: Which journal numbers the events; empty: not known yet.
        epoch: Grows when numbers begin anew: the manager lost its journal, or has an older one.
        on_restart: Called when they do.
    """

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._kept: deque[FleetEvent] = deque(maxlen=KEPT)
        self._changed = asyncio.Event()
        self.newest: int | None = None
        self.journal = ""
        self.epoch = 0
        self.on_restart: Callable[[], None] = _ignore

    def take(self, text: str) -> None:
        """Take an event of the topic; one that cannot be read is passed over."""
        try:
            event = json.loads(text)
            number, journal = int(event["number"]), str(event.pop("journal"))
        except (ValueError, TypeError, KeyError, AttributeError):
            return
        self._note(journal)
        if self.newest is not None and number <= self.newest:
            if self._is_known(event, number):
                return
            self._begin_anew()
        elif self._kept and number != self._kept[-1]["number"] + 1:
            self._kept.clear()
        self._kept.append(event)
        self.newest = number
        self._wake()

    def _is_known(self, event: FleetEvent, number: int) -> bool:
        if not self._kept or number < self._kept[0]["number"]:
            return bool(self._kept) and event.get("time", 0) <= self._kept[0].get("time", 0)
        return bool(self._kept[number - self._kept[0]["number"]] == event)

    def _note(self, journal: str) -> None:
        """Compare the journal with the one before."""
        if journal == self.journal:
            return
        is_first, self.journal = not self.journal, journal
        if not is_first:
            self._begin_anew()

    def _begin_anew(self) -> None:
        self._kept.clear()
        self.newest = None
        self.epoch += 1
        self._wake()
        self.on_restart()

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()

    async def _read(self, number: int, limit: int) -> EventBatch:
        """Ask the manager; notice if its numbers began anew."""
        known, epoch = self.newest, self.epoch
        found = await self._ask(number, limit)
        self._note(found.journal)
        if self.epoch == epoch and known is not None and found.newest < known:
            self._begin_anew()
        return found

    async def locate(self) -> int:
        """Return the number of the newest event, also if none was seen here yet.

        Raises:
            PlannerUnavailableError: The manager does not answer.
        """
        return (await self._read(0, 1)).newest

    @property
    def oldest(self) -> int:
        """The number of the oldest event that is kept here."""
        return int(self._kept[0]["number"])

    async def after(self, number: int, *, ask: bool = False) -> Sequence[FleetEvent]:
        """Return the next events after a number, the oldest first; none if there is no newer one.

        Args:
            number: The number.
            ask: Ask the manager, also if no newer event was seen on the topic.

        Raises:
            PlannerUnavailableError: They are not kept here, and the manager does not answer.
        """
        if not ask and self._kept and self._kept[0]["number"] <= number + 1 <= self._kept[-1]["number"] + 1:
            first = number + 1 - self._kept[0]["number"]
            return [self._kept[index] for index in range(first, min(first + PAGE, len(self._kept)))]
        return (await self._read(number, PAGE)).events

    async def wait(self, number: int) -> bool:
        """Wait for an event after a number; return False if none came for a while."""
        changed = self._changed
        if self.newest is not None and self.newest > number:
            return True
        try:
            async with asyncio.timeout(RECHECK_S):
                await changed.wait()
        except TimeoutError:
            return False
        return True


class EventCursor:
    """Follows the feed from a number on.

    Args:
        feed: The feed.
        number: The last event that the client has; None: it wants those from now on; 0 without a journal:
            all that are kept.
        journal: Which journal numbered it; empty: the client does not know.

    Attributes:
        number: The last event that was returned.
        journal: Which journal numbers the events.
    """

    def __init__(self, feed: EventFeed, number: int | None, journal: str = "") -> None:
        self._feed = feed
        self._epoch = feed.epoch
        self._wants_kept = number == 0 and not journal
        self.number = feed.newest if number is None else number
        self.journal = feed.journal if number is None else journal

    async def next(self) -> Sequence[FleetEvent]:
        """Wait for events; none came if it returns none.

        A client that wants events from now on gets none the first time, once the newest number is known.

        Raises:
            PlannerUnavailableError: The manager does not answer.
            EventsForgottenError: The next events are not kept any more; the next call begins after them.
            EventsRestartedError: The numbers began anew; the next call begins with the first event.
        """
        feed = self._feed
        if self.number is None and feed.newest is not None:
            self.number = feed.oldest - 1  # all of them came after this client
        newest = await self._check()
        if self.number is None:
            self.number = newest
            return ()
        found = await self._after(self.number)
        if not found:
            found = await self._after(self.number, ask=not await feed.wait(self.number))
        if found:
            self._look_for_gap(int(found[0]["number"]))
            self.number = int(found[-1]["number"])
        return found

    def _look_for_gap(self, number: int) -> None:
        """Notice that the events before the next one are not kept: events are numbered one by one."""
        wants_kept, self._wants_kept = self._wants_kept, False
        if self.number is not None and number > self.number + 1 and not wants_kept:
            first, self.number = self.number + 1, number - 1
            raise EventsForgottenError(self.journal, first, self.number)

    async def _after(self, number: int, *, ask: bool = False) -> Sequence[FleetEvent]:
        found = await self._feed.after(number, ask=ask)
        self._compare()
        return found

    async def _check(self) -> int | None:
        """Notice a client that has events of a journal that is gone; return the newest number."""
        feed, number = self._feed, self.number
        if feed.journal:
            self._compare()
        newest = feed.newest
        if not feed.journal or (number or 0) > (newest or 0) or (number is None and newest is None):
            newest = await feed.locate()
        self._compare(is_ahead=number is not None and newest is not None and number > newest)
        self.journal = feed.journal
        return newest

    def _compare(self, *, is_ahead: bool = False) -> None:
        feed = self._feed
        is_other = bool(self.journal) and self.journal != feed.journal
        if is_ahead or is_other or self._epoch != feed.epoch:
            self._epoch, self.journal, self.number = feed.epoch, feed.journal, 0
            self._wants_kept = False
            raise EventsRestartedError(feed.journal)
