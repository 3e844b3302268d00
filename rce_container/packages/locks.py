"""Locks by key, which exist only while a task holds or waits for them."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter, defaultdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Locks:
    """A lock for each key."""

    def __init__(self) -> None:
        self._locks: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._busy: Counter[str] = Counter()
        """How many tasks hold or wait for each lock."""

    def __contains__(self, key: str) -> bool:
        """Return whether a task holds or waits for a lock."""
        return key in self._busy

    @contextlib.asynccontextmanager
    async def of(self, key: str) -> AsyncIterator[None]:
        """Hold the lock of a key."""
        self._busy[key] += 1
        try:
            async with self._locks[key]:
                yield
        finally:
            self._busy[key] -= 1
            if not self._busy[key]:
                del self._busy[key], self._locks[key]
