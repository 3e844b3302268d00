"""Ways of idle robots to cells where they charge or wait."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rce_fleet.tasks.facts import RobotFacts
    from rce_fleet.tasks.progress import ProgressRules


class IdleWays:
    """Knows which cells idle robots can reach, and which ones they tried in vain.

    Args:
        rules: After which time a robot gives a cell up, as it gives a task up.
        nearest: Returns which of some cells a robot reaches first; None: it reaches none of them.
    """

    def __init__(
        self, rules: ProgressRules, nearest: Callable[[RobotFacts, Iterable[int]], int | None]
    ) -> None:
        self._rules = rules
        self._nearest = nearest
        self._now = -inf
        self._standing: Mapping[int, str] = {}
        self._avoid: dict[tuple[str, int], float] = {}
        """Until when a robot does not go to a cell again, by robot and cell."""

    def begin_step(self, now: float, standing: Mapping[int, str]) -> None:
        """Take over where robots stand that cannot be sent away.

        Args:
            now: Seconds since 1970.
            standing: The robot in each of these cells.
        """
        self._now, self._standing = now, standing
        self._avoid = {pair: until for pair, until in self._avoid.items() if until > now}

    def leave_floor(self) -> None:
        """Forget cells: the planner has another grid."""
        self._avoid.clear()

    def stands(self, cell: int) -> str:
        """Return which robot stands in a cell and cannot be sent away; empty: none."""
        return self._standing.get(cell, "")

    def is_closed(self, robot: RobotFacts, cell: int) -> bool:
        """Return whether a robot that goes to a cell cannot get there: it has to choose another one."""
        if robot.cell == cell:
            return False
        if self._nearest(robot, self._open(robot, (cell,))) is None:
            return True
        waited = self._now - robot.moved_at if robot.goal == cell else 0.0
        is_unreachable = robot.state == "unreachable" and waited > self._rules.unreachable_after
        if is_unreachable or waited > self._rules.stuck_after:
            self._avoid[robot.id, cell] = self._now + self._rules.avoid_for
            return True
        return False

    def nearest(self, robot: RobotFacts, cells: Iterable[int]) -> int | None:
        """Return which of some cells a robot reaches first; None: it reaches none of them now."""
        return self._nearest(robot, self._open(robot, cells))

    def _open(self, robot: RobotFacts, cells: Iterable[int]) -> list[int]:
        return [
            cell
            for cell in cells
            if self._standing.get(cell, robot.id) == robot.id and (robot.id, cell) not in self._avoid
        ]
