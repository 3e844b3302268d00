"""Measures how long robots that have something to do stand still. Pure."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce_fleet.drivers.report import WorldReport

MOVES = 0.1
"""A robot that is farther than this from where it stood has moved, metres."""


class Standstill:
    """The longest time for which a robot with a task did not move.

    Attributes:
        longest: This time, simulated seconds.
        robot: The robot that stood so long; empty before the first report.
    """

    def __init__(self) -> None:
        self.longest = 0.0
        self.robot = ""
        self._stands: dict[str, tuple[float, float, float]] = {}
        """Since when, and where, each robot with a task stands."""

    def update(self, truth: WorldReport, busy: Collection[str]) -> None:
        """Take a report of the world.

        Args:
            truth: Where the robots are.
            busy: The robots that have something to do.
        """
        now = truth.time_s
        for robot in truth.robots:
            known = self._stands.get(robot.id)
            moved = known is None or hypot(robot.x - known[1], robot.y - known[2]) > MOVES
            if moved or robot.id not in busy:
                self._stands[robot.id] = (now, robot.x, robot.y)
            elif known is not None and now - known[0] > self.longest:
                self.longest, self.robot = now - known[0], robot.id
