"""Says the same again now and then, not every time."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

EVERY = 5.0
"""Seconds until the same words are due again."""


class Reminder:
    """Tells whether something is to be said: at once if it is new, then every few seconds.

    Args:
        every: Seconds until the same words are due again.
        clock: Seconds.

    Example:
        >>> reminder = Reminder()
        >>> reminder.is_due("no answer"), reminder.is_due("no answer"), reminder.is_due("refused")
        (True, False, True)
    """

    def __init__(self, every: float = EVERY, clock: Callable[[], float] = time.monotonic) -> None:
        self._every = every
        self._clock = clock
        self._last = ""
        self._due = 0.0

    def is_due(self, words: str) -> bool:
        """Return whether the words are new or were said long ago; if so, they count as said now."""
        now = self._clock()
        if words == self._last and now < self._due:
            return False
        self._last, self._due = words, now + self._every
        return True
