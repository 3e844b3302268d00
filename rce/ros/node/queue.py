"""A queue that is never too long: the oldest give way. Pure."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_BYTES = 64 * 2**20
"""How many bytes a queue holds, unless a single item is longer."""


class DropOldest(Generic[T]):
    """A first-in first-out queue, bounded in items and bytes.

    Attributes:
        dropped: How many items were dropped because newer ones came.
    """

    def __init__(self, max_items: int, max_bytes: int = MAX_BYTES) -> None:
        if max_items < 1:
            raise ValueError(f"a queue holds at least one item, not {max_items}")
        self.dropped = 0
        self.max_items = max_items
        self._max_bytes = max_bytes
        self._items: deque[tuple[T, int]] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T, size: int) -> None:
        """Append an item of ``size`` bytes; drop from the other end what is too much."""
        self._items.append((item, size))
        self._bytes += size
        while len(self._items) > self.max_items or (self._bytes > self._max_bytes and len(self._items) > 1):
            self.dropped += 1
            self.take()

    def take(self) -> T:
        """Remove and return the oldest item.

        Raises:
            IndexError: The queue is empty.
        """
        item, size = self._items.popleft()
        self._bytes -= size
        return item

    def clear(self) -> None:
        """Remove all items; they do not count as dropped."""
        self._items.clear()
        self._bytes = 0
