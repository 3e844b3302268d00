"""Flow control between a sender and a receiver that are apart."""

from __future__ import annotations

import asyncio


class Window:
    """What may be sent before the receiver says that it took some. For one event loop.

    Args:
        size: What may be sent at first; None: there is no limit.

    Example:
        >>> window = Window(100)
        >>> await window.reserve(60), await window.reserve(60)
        (60, 40)
        >>> window.give_back(60)  # the receiver took so many
    """

    def __init__(self, size: int | None) -> None:
        self._left = size
        self._is_open = asyncio.Event()
        self._update()

    @property
    def is_closed(self) -> bool:
        """Whether nothing may be sent now."""
        return not self._is_open.is_set()

    async def reserve(self, most: int) -> int:
        """Wait until something may be sent; return how much, which is at most ``most``."""
        while self.is_closed:  # another sender may have been faster
            await self._is_open.wait()
        if self._left is None:
            return most
        granted = min(most, self._left)
        self._left -= granted
        self._update()
        return granted

    def give_back(self, amount: int) -> None:
        """Allow so much more: the receiver took it, or it was reserved and not sent."""
        if self._left is not None:
            self._left += amount
            self._update()

    def _update(self) -> None:
        if self._left is None or self._left > 0:
            self._is_open.set()
        else:
            self._is_open.clear()
