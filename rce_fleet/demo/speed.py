"""How fast the simulated world runs beside the machine's clock."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from rce_fleet.drivers.report import WorldReport

TELL_EVERY_S = 30.0
TELL_CHANGE = 0.1
"""A factor that differs less from the one that was told is not told again."""


class WorldSpeed:
    """Measures simulated seconds per second, from the first look at the world to the last.

    Attributes:
        seconds: Seconds between the two.
        simulated: The same by the time of the simulated world.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.simulated = 0.0
        self._first: tuple[float, float] | None = None

    def look(self, truth: WorldReport, now: float) -> None:
        """Take the state of the world at a time; one that was reset is measured anew."""
        if self._first is None or truth.time_s < self._first[1] + self.simulated:
            self._first = (now, truth.time_s)
        self.seconds, self.simulated = now - self._first[0], truth.time_s - self._first[1]

    @property
    def factor(self) -> float:
        """Simulated seconds per second; 0 if not known yet."""
        return self.simulated / self.seconds if self.seconds else 0.0


async def tell_speed(
    truth: Callable[[], WorldReport | None],
    say: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Print the real-time factor of the last half minute when it has changed, until cancelled.

    Args:
        truth: Returns the state of the simulated world.
        say: Prints a line for the user.
        clock: Returns the time, seconds.
    """
    told: float | None = None
    while True:
        speed = WorldSpeed()
        for pause in (TELL_EVERY_S, 0.0):
            if (seen := truth()) is not None:
                speed.look(seen, clock())
            await asyncio.sleep(pause)
        if speed.seconds and (told is None or abs(speed.factor - told) >= TELL_CHANGE):
            told = speed.factor
            say(f"real-time factor {told:.2f}")
