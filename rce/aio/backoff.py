"""Pauses between attempts, which double, with jitter or without."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Protocol

_MOST_DOUBLINGS = 64
"""More doublings than any pause needs, and few enough for a float."""


class UniformSource(Protocol):
    """Draws random numbers; :class:`random.Random` and the module :mod:`random` are such sources."""

    def uniform(self, a: float, b: float, /) -> float:
        """Return a number between ``a`` and ``b``."""


@dataclass(frozen=True, slots=True)
class Backoff:
    """Pauses between attempts. They double with each failure in a row, up to a longest one.

    A pure value. A state machine that counts its failures asks :meth:`pause_after`; a loop that waits lets
    :meth:`start` count them.

    Example:
        >>> [Backoff(first=0.5, longest=3.0).pause_after(failures) for failures in range(5)]
        [0.0, 0.5, 1.0, 2.0, 3.0]

        >>> pauses = Backoff(first=0.1, longest=5.0, jitter=0.5).start()
        >>> while True:
        ...     try:
        ...         await use(await connect())
        ...         pauses.reset()
        ...     except OSError:
        ...         pass
        ...     await asyncio.sleep(pauses.next())
    """

    first: float
    """Pause after the first failure, in seconds."""
    longest: float
    """Longest pause, in seconds."""
    jitter: float = 0.0
    """Which part of a pause is random: 0 none, 0.5 its second half, 1 all of it (*full jitter*).

    Peers that lost the same server at the same moment come back spread out in time.
    """

    def __post_init__(self) -> None:
        if not (0.0 <= self.first <= self.longest and 0.0 <= self.jitter <= 1.0):
            raise ValueError(f"expected 0 <= first <= longest and 0 <= jitter <= 1, found {self}")

    def pause_after(self, failures: int) -> float:
        """Return the pause after so many failures in a row, in seconds and without jitter; 0 after none."""
        if failures <= 0:
            return 0.0
        return min(self.longest, self.first * 2.0 ** min(failures - 1, _MOST_DOUBLINGS))

    def start(self, source: UniformSource = random) -> Pauses:
        """Begin to count failures.

        Args:
            source: Random source of the jitter.
        """
        return Pauses(self, source)


class Pauses:
    """Counts the failures of one loop, and returns the length of each pause. See :class:`Backoff`."""

    def __init__(self, backoff: Backoff, source: UniformSource) -> None:
        self._backoff = backoff
        self._source = source
        self._failures = 0

    def next(self) -> float:
        """Count a failure; return how long to wait before the next attempt, in seconds."""
        self._failures += 1
        pause = self._backoff.pause_after(self._failures)
        return pause - pause * self._source.uniform(0.0, self._backoff.jitter)

    def reset(self) -> None:
        """Reset the count to 0: an attempt succeeded."""
        self._failures = 0
