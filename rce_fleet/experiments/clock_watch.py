"""Notices that the machine's clock was set while something was measured, or that the machine slept.

Messages have stamps of the clock, which people and time servers set. A step would be in delays and rates,
and a machine that sleeps counts its sleep as time without messages.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rce_fleet.exceptions import ExperimentError

if TYPE_CHECKING:
    from collections.abc import Callable

STEP_S = 0.01
"""A smaller step changes no figure much; a clock that is slewed has none."""
READS = 5
"""The two clocks are not read at the same moment: the closest of some readings counts."""


class ClockWatch:
    """Compares the clock with one that nothing sets, from its making on.

    Args:
        wall: The clock, seconds since 1970.
        steady: Seconds that never go back; they stop while the machine sleeps.
    """

    def __init__(
        self, wall: Callable[[], float] = time.time, steady: Callable[[], float] = time.monotonic
    ) -> None:
        self._wall = wall
        self._steady = steady
        self._lead = self._read()

    def check(self) -> None:
        """Make sure that the clock was not set.

        Raises:
            ExperimentError: It was; the text says by how much.
        """
        step = self._read() - self._lead
        if abs(step) > STEP_S:
            raise ExperimentError(
                f"the clock of this machine was set by {step:+.2f} s meanwhile, or the machine slept"
            )

    def _read(self) -> float:
        """Return by how much the clock is ahead of the other one, seconds."""
        found = []
        for _ in range(READS):
            before = self._steady()
            wall = self._wall()
            after = self._steady()
            found.append((after - before, wall - (before + after) / 2))
        return min(found)[1]
