"""The fleet's time: seconds since 1970 that never go back."""

from __future__ import annotations

import time

SLOWER = 0.9
"""So fast the fleet's time runs while it is ahead of the machine's clock."""


class WallClock:
    """Seconds since 1970 that never go back.

    Steps of the machine's clock to later times are followed at once. While the machine's clock is behind,
    because it was set back or the journal is of a machine that was ahead, this one runs a tenth slower, until
    both agree.

    Args:
        least: It begins here at the earliest: the time of the last event of the journal.

    Attributes:
        stepped: Seconds by which it has followed steps to later times; set it to 0 after use.
    """

    def __init__(self, least: float = 0.0) -> None:
        self._read_at = time.monotonic()
        self._now = max(time.time(), least)
        self.stepped = 0.0

    def __call__(self) -> float:
        """Return the time."""
        read_at, wall = time.monotonic(), time.time()
        passed, self._read_at = max(0.0, read_at - self._read_at), read_at
        if wall >= self._now + passed:
            self.stepped += wall - self._now - passed
            self._now = wall
        else:
            self._now = max(wall, self._now + passed * SLOWER)
        return self._now

    @property
    def lead(self) -> float:
        """How many seconds it is ahead of the machine's clock."""
        return max(0.0, self() - time.time())
