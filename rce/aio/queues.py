"""Bounded queues with an overflow policy. Pure: no event loop, no clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")


class OverflowPolicy(Enum):
    """How a full queue handles a new item."""

    DROP_OLDEST = "drop oldest"
    """Drop the oldest items, and count them. For topics, where the newest is worth most."""
    REFUSE = "refuse"
    """Refuse new items, and tell the sender. For services, where nothing may be lost."""


class BoundedQueue(Generic[T]):
    """First in, first out; bounded in items and bytes.

    An empty queue takes any item, however large. An item with a *key* is *kept*: it is dropped only after a
    newer one with the same key has come, and until then it does not count in the bounds. (A latched message
    is such an item; its source is the key.)

    Args:
        max_items: Most items, without those that are kept.
        max_bytes: Most bytes, without those that are kept.
        policy: How a full queue handles a new item.
        on_drop: Called with each item that is dropped to make room.

    Attributes:
        max_items, max_bytes, policy: As given.
        bytes: Of all items.
        kept_bytes: Of the items that are kept.
        dropped: How many items were dropped to make room.

    Raises:
        ValueError: ``max_items`` is less than 1.

    Example:
        >>> queue: BoundedQueue[str] = BoundedQueue(max_items=2, max_bytes=100)
        >>> for text in ("a", "b", "c"):
        ...     queue.put(text, len(text))
        >>> queue.take(), queue.take(), queue.dropped
        ('b', 'c', 1)
    """

    __slots__ = (
        "_entries",
        "_kept",
        "_on_drop",
        "bytes",
        "dropped",
        "kept_bytes",
        "max_bytes",
        "max_items",
        "policy",
    )

    def __init__(
        self,
        max_items: int,
        max_bytes: int,
        policy: OverflowPolicy = OverflowPolicy.DROP_OLDEST,
        on_drop: Callable[[T], object] | None = None,
    ) -> None:
        if max_items < 1:
            raise ValueError(f"a queue holds at least one item, not {max_items}")
        self.max_items = max_items
        self.max_bytes = max_bytes
        self.bytes = 0
        self.kept_bytes = 0
        self.dropped = 0
        self.policy = policy
        self._on_drop = on_drop
        self._entries: deque[tuple[T, int, Hashable]] = deque()
        self._kept: dict[Hashable, tuple[T, int, Hashable]] = {}
        """By key: the newest entry that has it."""

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[T]:
        return (entry[0] for entry in self._entries)

    @property
    def droppable(self) -> int:
        """How many items may be dropped: all but those that are kept."""
        return len(self._entries) - len(self._kept)

    @property
    def droppable_bytes(self) -> int:
        """The bytes of the items that may be dropped."""
        return self.bytes - self.kept_bytes

    @property
    def head(self) -> T:
        """The oldest item.

        Raises:
            IndexError: The queue is empty.
        """
        return self._entries[0][0]

    @property
    def head_size(self) -> int:
        """The bytes of the oldest item.

        Raises:
            IndexError: The queue is empty.
        """
        return self._entries[0][1]

    @property
    def kept_head(self) -> Hashable:
        """The key of the oldest item if that is kept; None if it may be dropped.

        Raises:
            IndexError: The queue is empty.
        """
        entry = self._entries[0]
        return entry[2] if self._is_kept(entry) else None

    def peek(self) -> T | None:
        """Return the oldest item, None if the queue is empty."""
        return self._entries[0][0] if self._entries else None

    def put(self, item: T, size: int, key: Hashable = None) -> bool:
        """Append an item, and drop the oldest ones that no longer fit.

        Args:
            item: The item.
            size: Its bytes.
            key: Keeps the item until a newer one with this key comes; None: it may be dropped.

        Returns:
            False if the queue is full and its policy is to refuse; an item with a key is always taken.
        """
        entry = (item, size, key)
        if key is None:
            if self._entries and not self.make_room(size):
                return False
            self._entries.append(entry)
            self.bytes += size
        else:
            former = self._kept.get(key)
            if former is not None:
                self.kept_bytes -= former[1]
            self._kept[key] = entry
            self._entries.append(entry)
            self.bytes += size
            self.kept_bytes += size
            while self.droppable > 1 and self._is_over():
                self.drop_oldest()
        return True

    def make_room(self, size: int) -> bool:
        """Drop the oldest items that must go before one of ``size`` bytes may come.

        Returns:
            False if the queue is full and its policy is to refuse; nothing was dropped then.
        """
        while self._is_full(size):
            if self.policy is OverflowPolicy.REFUSE:
                return False
            self.drop_oldest()
        return True

    def take(self) -> T:
        """Remove and return the oldest item.

        Raises:
            IndexError: The queue is empty.
        """
        entry = self._entries.popleft()
        if entry[2] is None:
            self.bytes -= entry[1]
        else:
            self._forget(entry)
        return entry[0]

    def drop_oldest(self) -> bool:
        """Drop the oldest item that is not kept; return False if all are kept."""
        for index, entry in enumerate(self._entries):
            if not self._is_kept(entry):
                del self._entries[index]
                self.bytes -= entry[1]
                self.dropped += 1
                if self._on_drop is not None:
                    self._on_drop(entry[0])
                return True
        return False

    def shed(self, size: int) -> None:
        """Drop the oldest items that are not kept, until ``size`` bytes are free or all others are kept."""
        goal = self.bytes - size
        while self.bytes > goal and self.drop_oldest():
            pass

    def remove(self, matches: Callable[[T], bool]) -> bool:
        """Remove the oldest item that matches, which does not count as dropped; return False if none does."""
        for index, entry in enumerate(self._entries):
            if matches(entry[0]):
                del self._entries[index]
                self._forget(entry)
                return True
        return False

    def remove_kept(self, key: Hashable) -> bool:
        """Remove the item kept for a key, which does not count as dropped; return False if none is kept."""
        kept = self._kept.get(key)
        if kept is None:
            return False
        index = next(index for index, entry in enumerate(self._entries) if entry is kept)
        del self._entries[index]
        self._forget(kept)
        return True

    def release(self, key: Hashable) -> None:
        """Have the item kept for a key, if there is one, count and be dropped like others from now on."""
        kept = self._kept.pop(key, None)
        if kept is not None:
            self.kept_bytes -= kept[1]

    def clear(self) -> None:
        """Remove all items; they do not count as dropped."""
        self._entries.clear()
        self._kept.clear()
        self.bytes = self.kept_bytes = 0

    def _is_kept(self, entry: tuple[T, int, Hashable]) -> bool:
        return entry[2] is not None and self._kept.get(entry[2]) is entry

    def _forget(self, entry: tuple[T, int, Hashable]) -> None:
        """Subtract a removed entry from the counters."""
        self.bytes -= entry[1]
        if self._is_kept(entry):
            del self._kept[entry[2]]
            self.kept_bytes -= entry[1]

    def _is_full(self, size: int) -> bool:
        """Return whether items must be dropped before ``size`` more bytes fit."""
        droppable = len(self._entries) - len(self._kept)
        return droppable > 0 and (
            droppable >= self.max_items or self.bytes - self.kept_bytes + size > self.max_bytes
        )

    def _is_over(self) -> bool:
        return self.droppable > self.max_items or self.droppable_bytes > self.max_bytes
