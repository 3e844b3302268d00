"""How late the velocities of an operator are who drives by hand. Pure.

The station's clock comes with each velocity. It has nothing to do with the robot's clock: a velocity is late
if it took longer than the fastest one of the last seconds.
"""

from __future__ import annotations

from collections import deque
from math import isfinite

LATE_S = 0.35
"""A velocity that took this much longer than the fastest one is late."""
SILENT_S = 2.0
"""After this time without a velocity, another drive begins, perhaps at another station."""
WINDOW = 200
"""Velocities of which the fastest one is known."""


class DriveClock:
    """Judges velocities by the time of the station's clock that comes with them."""

    def __init__(self) -> None:
        self._delays: deque[float] = deque(maxlen=WINDOW)
        self._sent = float("-inf")
        self._at = float("-inf")

    def take(self, sent: float, now: float) -> bool:
        """Take the time at which a velocity was sent; one that is not finite is ignored.

        Args:
            sent: Seconds of the station's clock.
            now: Seconds of the robot's clock, which is never set.

        Returns:
            Whether it was taken.
        """
        if not isfinite(sent):
            return False
        if sent < self._sent or now - self._at > SILENT_S:
            self._delays.clear()
        self._sent, self._at = sent, now
        self._delays.append(now - sent)
        return True

    def is_late(self, now: float) -> bool:
        """Return whether the newest velocity is late; velocities without a clock never are."""
        if now - self._at > SILENT_S or not self._delays:
            return False
        return self._delays[-1] - min(self._delays) > LATE_S
