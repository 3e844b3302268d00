"""Notices another planner that drives the same robots, in another ROS graph. Pure.

Move clients report which planner gave them their grid or list last; a planner's name is when it began. After
a restart they report the planner before, until the new one has reached them. So a robot counts only if it has
reported this planner and then another one, twice: the other one gave it a grid or list again after this one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

WITHIN_S = 60.0
"""Both reports of another planner come within this time, seconds: planners repeat their grid every 5 s."""
_NAME = re.compile(r"([0-9]{1,10})\.([0-9]{9})")


@dataclass(frozen=True, slots=True)
class OtherPlanner:
    """Another planner that drives a robot of this one.

    Attributes:
        robot: The robot.
        name: The planner: when it began, ``SECONDS.NANOSECONDS``.
        is_newer: Whether it began after this one.
    """

    robot: str
    name: str
    is_newer: bool

    @property
    def began(self) -> int:
        """When it began, whole seconds since 1970."""
        return began_at(self.name)[0]


def began_at(name: str) -> tuple[int, int]:
    """Return when a planner began, by its name: seconds since 1970, nanoseconds; zeros: it is not a name."""
    found = _NAME.fullmatch(name)
    return (int(found[1]), int(found[2])) if found is not None else (0, 0)


class PlannerWatch:
    """Compares the planners that move clients report with this one.

    Args:
        own: Name of this planner.
    """

    def __init__(self, own: str) -> None:
        self._own = own
        self._names = {own}
        """All names of this planner: each change of its grid gives it another one."""
        self._reported: dict[str, str] = {}
        self._changed_at: dict[str, float] = {}
        """When a robot went over to another planner."""

    def rename(self, own: str) -> None:
        """Note that this planner began anew, with another grid."""
        self._own = own
        self._names.add(own)

    def is_with_other(self, robot: str) -> bool:
        """Return whether a robot's move client reported another planner last."""
        return self._reported.get(robot, self._own) not in self._names

    def take(self, robot: str, planner: str, now: float) -> OtherPlanner | None:
        """Take a move client's report; return another planner that drives the robot, if it shows one.

        Args:
            robot: The robot.
            planner: Name of the planner that its move client was given grid or list by; empty: not told.
            now: Seconds, monotonic.
        """
        if began_at(planner) == (0, 0):
            return None
        before = self._reported.get(robot)
        self._reported[robot] = planner
        if before not in self._names or planner in self._names:
            return None
        last, self._changed_at[robot] = self._changed_at.get(robot), now
        if last is None or now - last > WITHIN_S:
            return None
        return OtherPlanner(robot, planner, began_at(planner) > began_at(self._own))
