"""How much each robot has worked of late: what makes the assignment of tasks fair."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from rce_fleet.tasks.task import Task

HALF_LIFE = 3600.0
"""Seconds after which work counts half."""
_LONGEST = 60.0
"""A longer time between two updates counts as so much: nothing was seen of what robots did in it."""


class Workloads:
    """The share of the time in which robots had tasks; the longer ago, the less it counts."""

    def __init__(self) -> None:
        self._shares: dict[str, float] = {}
        self._updated_at = -inf

    def share(self, robot: str) -> float:
        """Return a robot's share, 0 .. 1; 0 for a robot that is not known."""
        return self._shares.get(robot, 0.0)

    def begin(self, robots: Iterable[str], tasks: Iterable[Task], now: float) -> None:
        """Count tasks that ended before, as after a restart.

        Args:
            robots: Robots that are known.
            tasks: Tasks that are still known.
            now: Seconds since 1970.
        """
        self._shares = dict.fromkeys(robots, 0.0)
        for task in tasks:
            if task.has_ended and task.robot and task.started_at is not None:
                began, ended = (min(at, now) for at in (task.started_at, task.changed_at))
                worked = _decay(now - ended) - _decay(now - min(began, ended))
                self._shares[task.robot] = min(self.share(task.robot) + worked, 1.0)

    def update(self, now: float, robots: Collection[str], busy: Collection[str]) -> None:
        """Add the time since the last call.

        A robot that is new counts as if it had worked like the others: it does not get all tasks at first.

        Args:
            now: Seconds since 1970; may have been set back.
            robots: All robots.
            busy: Those of them that have a task.
        """
        passed = min(max(now - self._updated_at, 0.0), _LONGEST)
        self._updated_at = now
        known = [self._shares[robot] for robot in robots if robot in self._shares]
        mean = sum(known) / len(known) if known else 0.0
        kept = _decay(passed)
        self._shares = {
            robot: self._shares.get(robot, mean) * kept + (1.0 - kept if robot in busy else 0.0)
            for robot in robots
        }


def _decay(seconds: float) -> float:
    return float(0.5 ** (seconds / HALF_LIFE))
