"""Places that are taken as long as something is open, such as streams; bounded for each holder, and in all.

Nothing waits: what finds no place is refused. :mod:`rce.guard.turns` lets it wait instead.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


class NoPlaceError(Exception):
    """All places are taken.

    Attributes:
        most: How many there are.
        is_own: Whether it is the holder who has them; otherwise all holders together do.
    """

    def __init__(self, most: int, *, is_own: bool) -> None:
        self.most = most
        self.is_own = is_own
        super().__init__(f"all {most} places are taken")


class Places:
    """Places by holder.

    Args:
        each: Places of one holder; 0: no limit.
        most: Places of all holders together; 0: no limit.

    Example:
        >>> places = Places(each=1)
        >>> with places.place("anna"), places.place("bert"):
        ...     len(places)
        2
    """

    def __init__(self, *, each: int, most: int = 0) -> None:
        self._each = each
        self._most = most
        self._taken: Counter[str] = Counter()

    def __len__(self) -> int:
        return self._taken.total()

    def of(self, holder: str) -> int:
        """Return how many places a holder has."""
        return self._taken[holder]

    @contextlib.contextmanager
    def place(self, holder: str) -> Iterator[None]:
        """Have a place as long as the context lasts.

        Raises:
            NoPlaceError: The holder has all its places already, or no place is left.
        """
        if self._each and self._taken[holder] >= self._each:
            raise NoPlaceError(self._each, is_own=True)
        if self._most and len(self) >= self._most:
            raise NoPlaceError(self._most, is_own=False)
        self._taken[holder] += 1
        try:
            yield
        finally:
            self._taken[holder] -= 1
            if not self._taken[holder]:
                del self._taken[holder]
