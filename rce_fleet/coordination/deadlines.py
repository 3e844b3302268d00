"""The time of each robot's next check, so that a timer event handles only the robots that are due."""

from __future__ import annotations

from heapq import heappop, heappush
from math import inf

ROUNDING = 1e-6
"""Seconds by which a check may be early: sums of times are rounded."""


class Deadlines:
    """One time per robot, in seconds of the planner's clock."""

    def __init__(self) -> None:
        self._due: dict[str, float] = {}
        self._heap: list[tuple[float, str]] = []

    def set(self, robot: str, due: float) -> None:
        """Set the time of a robot's next check."""
        if self._due.get(robot) != due:
            self._due[robot] = due
            if due < inf:
                heappush(self._heap, (due, robot))

    def hasten(self, robot: str, due: float) -> None:
        """Set the time of a robot's next check, unless an earlier one is set."""
        if due < self._due.get(robot, inf):
            self.set(robot, due)

    def forget(self, robot: str) -> None:
        """Remove a robot."""
        self._due.pop(robot, None)

    def take_due(self, now: float) -> list[str]:
        """Return the robots that are due, the earliest first, and remove their times."""
        due = []
        while self._heap and self._heap[0][0] <= now + ROUNDING:
            time, robot = heappop(self._heap)
            if self._due.get(robot) == time:
                del self._due[robot]
                due.append(robot)
        return due

    def __getitem__(self, robot: str) -> float:
        """Return the time of a robot's next check; ``inf`` if none is set."""
        return self._due.get(robot, inf)
