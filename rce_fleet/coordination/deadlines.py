"""When each robot has to be looked at next, so that a tick of the clock touches only those that are due."""

from __future__ import annotations

from heapq import heappop, heappush
from math import inf

ROUNDING = 1e-6
"""Seconds that a robot is looked at too early at most: sums of times are rounded."""


class Deadlines:
    """One time for each robot, by the planner's clock in seconds."""

    def __init__(self) -> None:
        self._due: dict[str, float] = {}
        self._heap: list[tuple[float, str]] = []

    def set(self, robot: str, due: float) -> None:
        """Have a robot looked at when ``due`` has come, and not for what was set before."""
        if self._due.get(robot) != due:
            self._due[robot] = due
            if due < inf:
                heappush(self._heap, (due, robot))

    def hasten(self, robot: str, due: float) -> None:
        """Have a robot looked at when ``due`` has come, unless it is looked at earlier anyway."""
        if due < self._due.get(robot, inf):
            self.set(robot, due)

    def forget(self, robot: str) -> None:
        """Do not look at a robot any more."""
        self._due.pop(robot, None)

    def take_due(self, now: float) -> list[str]:
        """Return the robots whose time has come, the earliest first; they have none until one is set."""
        due = []
        while self._heap and self._heap[0][0] <= now + ROUNDING:
            time, robot = heappop(self._heap)
            if self._due.get(robot) == time:
                del self._due[robot]
                due.append(robot)
        return due

    def __getitem__(self, robot: str) -> float:
        """When a robot is looked at next; ``inf`` if never."""
        return self._due.get(robot, inf)
