"""Turns at a scarce resource, such as worker threads, shared fairly between crowds and their members.

A crowd is a source that may act as one: an address, or a user. Each waiting crowd gets a turn before any
gets another one; within a crowd the same holds for its members. When too many wait, the newest request of
the largest member of the largest crowd is refused. So a member that asks a thousand times waits for its own
turns, and others, also those of the same crowd, wait for one of them.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter, OrderedDict, deque
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

_Crowd: TypeAlias = "OrderedDict[str, deque[asyncio.Future[None]]]"


class CrowdedError(Exception):
    """Too many of the crowd wait already."""


class Turns:
    """Allows a number of users at a time; the others wait for their turns.

    Args:
        at_once: How many may work at the same time.
        waiting: How many may wait.
        each: How many of one crowd may work at the same time; 0: as many as there is room for.

    Example:
        >>> async def work(turns: Turns) -> None:
        ...     async with turns.turn("192.0.2.7", "anna"):
        ...         ...
    """

    def __init__(self, at_once: int, *, waiting: int, each: int = 0) -> None:
        self._at_once = at_once
        self._most_waiting = waiting
        self._each = each or at_once
        self._working: Counter[str] = Counter()
        self._crowds: OrderedDict[str, _Crowd] = OrderedDict()

    @property
    def working(self) -> int:
        """How many have a turn now."""
        return self._working.total()

    @property
    def waiting(self) -> int:
        """How many wait."""
        return sum(map(_size, self._crowds.values()))

    @contextlib.asynccontextmanager
    async def turn(self, crowd: str, member: str = "") -> AsyncIterator[None]:
        """Wait for a turn, and have it until the context ends.

        Args:
            crowd: The crowd that it counts for.
            member: The same within the crowd.

        Raises:
            CrowdedError: Too many wait, this crowd is the largest, and this member waits most often in it.
        """
        if self._has_room(crowd):
            self._working[crowd] += 1
        else:
            await self._wait(crowd, member)
        try:
            yield
        finally:
            self._leave(crowd)

    def _has_room(self, crowd: str) -> bool:
        return self._working.total() < self._at_once and self._working[crowd] < self._each

    async def _wait(self, crowd: str, member: str) -> None:
        if self.waiting >= self._most_waiting:
            self._make_room(crowd, member)
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._crowds.setdefault(crowd, OrderedDict()).setdefault(member, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled() and turn.exception() is None:
                self._leave(crowd)
            else:
                self._forget(crowd, member, turn)
            raise

    def _make_room(self, crowd: str, member: str) -> None:
        """Refuse the newest request of the largest crowd's largest member; raise if that is the caller."""
        largest = max(self._crowds, key=lambda name: _size(self._crowds[name]))
        own = self._crowds.get(crowd, OrderedDict())
        if _size(own) >= _size(self._crowds[largest]):
            largest = crowd
        members = self._crowds[largest]
        loser = max(members, key=lambda name: len(members[name]))
        if largest == crowd and len(members.get(member, ())) >= len(members[loser]):
            raise CrowdedError
        turn = members[loser][-1]
        self._forget(largest, loser, turn)
        if not turn.done():  # it may just have been cancelled
            turn.set_exception(CrowdedError())

    def _forget(self, crowd: str, member: str, turn: asyncio.Future[None]) -> None:
        members = self._crowds.get(crowd, OrderedDict())
        waiting = members.get(member, deque())
        with contextlib.suppress(ValueError):  # it was refused just before it was cancelled
            waiting.remove(turn)
        self._tidy(crowd, member)

    def _tidy(self, crowd: str, member: str) -> None:
        members = self._crowds.get(crowd)
        if members is None:
            return
        if not members.get(member, True):
            del members[member]
        if not members:
            del self._crowds[crowd]

    def _leave(self, crowd: str) -> None:
        self._working[crowd] -= 1
        if not self._working[crowd]:
            del self._working[crowd]
        while (chosen := next(filter(self._has_room, self._crowds), None)) is not None:
            self._call(chosen)

    def _call(self, crowd: str) -> None:
        """Give the next of a crowd its turn."""
        members = self._crowds[crowd]
        member = next(iter(members))
        turn = members[member].popleft()
        members.move_to_end(member)
        self._crowds.move_to_end(crowd)
        self._tidy(crowd, member)
        if not turn.done():
            self._working[crowd] += 1
            turn.set_result(None)


def _size(crowd: _Crowd) -> int:
    return sum(map(len, crowd.values()))
