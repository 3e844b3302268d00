"""A bounded queue of events that is an async iterator."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_WAITING = 10_000


class EventQueue(Generic[T]):
    """What happened, in order; never ends.

    Attributes:
        lost: How many events were dropped, the oldest first, because nobody took them.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._events: deque[T] = deque()
        self._arrived = asyncio.Event()

    def put(self, event: T) -> None:
        """Add an event."""
        if len(self._events) >= MAX_WAITING:
            self._events.popleft()
            self.lost += 1
        self._events.append(event)
        self._arrived.set()

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        while not self._events:
            self._arrived.clear()
            await self._arrived.wait()
        return self._events.popleft()
