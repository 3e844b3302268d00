"""A bounded queue of events that is an async iterator."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Generic, TypeVar

from rce.aio.queues import BoundedQueue

T = TypeVar("T")

MAX_WAITING = 10_000


class EventQueue(Generic[T]):
    """Events, in order; never ends."""

    def __init__(self) -> None:
        self._events: BoundedQueue[T] = BoundedQueue(MAX_WAITING, max_bytes=0)  # events count no bytes
        self._arrived = asyncio.Event()

    @property
    def lost(self) -> int:
        """How many events were dropped, the oldest first, because they were not taken."""
        return self._events.dropped

    def put(self, event: T) -> None:
        """Add an event."""
        self._events.put(event, 0)
        self._arrived.set()

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        while not self._events:
            self._arrived.clear()
            await self._arrived.wait()
        return self._events.take()
