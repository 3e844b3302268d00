"""The data that the holder of an account holds outside its queues, and how to drop each item (sans-I/O).

Queues count their own bytes. Everything else that keeps a message in memory, such as a call that waits for
its answer, a latched message or a running conversion, has an entry here for as long as it does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Holding:
    """One entry. Call :meth:`release` when it is not held any more; further calls have no effect.

    A released entry does not refer to what gave up its data: that often refers to the data and, through its
    owner, to the entry itself. Such a cycle would keep the data until the next garbage collection, which
    counts objects and no bytes.
    """

    __slots__ = ("_give_up", "_holdings", "size")

    def __init__(self, holdings: Holdings, size: int, give_up: Callable[[], object] | None) -> None:
        self._holdings = holdings
        self._give_up = give_up
        self.size = size

    def release(self) -> None:
        """Take note that it is not held any more."""
        self._holdings._release(self)  # noqa: SLF001 - same module


class Holdings:
    """All entries of one holder, oldest first.

    Args:
        on_growth: Called after something was added; may call :meth:`shed`.

    Attributes:
        bytes: Held.
    """

    def __init__(self, on_growth: Callable[[], None] = lambda: None) -> None:
        self._on_growth = on_growth
        self._held: dict[Holding, None] = {}
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._held)

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        """Add an entry.

        Args:
            size: Bytes.
            give_up: Drops the data; called when memory is short, after the entry was removed. May be called
                before this returns. None if the data cannot be dropped.
        """
        holding = Holding(self, size, give_up)
        self._held[holding] = None
        self.bytes += size
        self._on_growth()
        return holding

    def shed(self, size: int) -> None:
        """Drop the oldest droppable entries, until ``size`` bytes are free."""
        goal = self.bytes - size
        self.shed_until(lambda: self.bytes <= goal)

    def shed_until(self, is_enough: Callable[[], bool]) -> None:
        """Drop the oldest droppable entries, until it is enough or none is left."""
        for holding in list(self._held):
            if is_enough():
                return
            give_up = holding._give_up  # noqa: SLF001 - same module
            if holding in self._held and give_up is not None:
                self._release(holding)
                give_up()

    def _release(self, holding: Holding) -> None:
        if holding in self._held:
            del self._held[holding]
            self.bytes -= holding.size
            holding._give_up = None  # noqa: SLF001 - same module
