"""The goals of one simulated ``move_base``, as an actionlib server keeps them.

A new goal replaces the current one; a cancellation names a goal or a time, and goals with an earlier time
stamp are recalled even if they arrive later.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from rce_fleet.coordination.move_client import GoalState

REMEMBER = 5.0
"""Seconds for which a finished goal stays in the status list."""


@dataclass(slots=True)
class Goal:
    """A navigation goal: id, time stamp (seconds), place (metres) and state; why it was refused."""

    id: str
    stamp: float
    place: tuple[float, float]
    state: GoalState = GoalState.ACTIVE
    ended_at: float = 0.0
    fault: str = ""


class GoalList:
    """Keeps the goals of one robot.

    Attributes:
        current: The goal that the robot drives to; None without one.
        ending: What becomes of it once the robot stands; None while it drives on.
        now: Time of what happens, seconds.
    """

    def __init__(self) -> None:
        self.current: Goal | None = None
        self.ending: GoalState | None = None
        self.now = 0.0
        self._goals: dict[str, Goal] = {}
        self._ended: list[Goal] = []
        self._recalled_until = float("-inf")
        self._unnamed = 0
        """Goals that came without an id."""

    @property
    def goals(self) -> list[Goal]:
        """The goals in the status list: the current one, and those that ended recently."""
        return list(self._goals.values())

    @property
    def has_ended(self) -> bool:
        """Whether a goal ended since the last :meth:`take_ended`."""
        return bool(self._ended)

    def take_ended(self) -> list[Goal]:
        """Return the goals that ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def accept(self, goal_id: str, stamp: float, x: float, y: float) -> bool:
        """Accept a goal; return whether the robot has to drive to it. A known one changes nothing.

        One whose place is not finite is rejected, and the goal before it stays. One without an id gets one.
        """
        if not goal_id:
            self._unnamed += 1
            goal_id = f"goal-{self._unnamed}"
        if goal_id in self._goals:
            return False
        goal = self._goals[goal_id] = Goal(goal_id, stamp, (x, y))
        if not (isfinite(x) and isfinite(y)):
            goal.fault = f"target_pose.pose.position is x={x}, y={y}; send finite numbers, in metres"
            self._end(goal, GoalState.REJECTED)
            return False
        if stamp and stamp <= self._recalled_until:
            self._end(goal, GoalState.RECALLED)
            return False
        if self.current is not None:
            self._end(self.current, GoalState.PREEMPTED)
        self.current, self.ending = goal, None
        return True

    def cancel(self, goal_id: str, stamp: float) -> bool:
        """Cancel the goal of this id and goals with a time up to ``stamp``; all if neither is given.

        Returns:
            Whether the robot has to brake.
        """
        if stamp:
            self._recalled_until = max(self._recalled_until, stamp)
        goal = self.current
        if goal is None or goal.state is not GoalState.ACTIVE:
            return False
        is_earlier = stamp != 0 and goal.stamp <= stamp
        if goal.id == goal_id or is_earlier or (not goal_id and not stamp):
            goal.state = GoalState.PREEMPTING
            self.ending = GoalState.PREEMPTED
            return True
        return False

    def end(self) -> None:
        """End the current goal, if there is one: the robot stands, where it was sent or where it braked."""
        if self.current is not None:
            self._end(self.current, self.ending or GoalState.SUCCEEDED)

    def forget(self) -> None:
        """Remove goals from the status list that ended long ago."""
        for goal in [goal for goal in self._goals.values() if goal.state.over]:
            if self.now - goal.ended_at > REMEMBER:
                del self._goals[goal.id]

    def _end(self, goal: Goal, state: GoalState) -> None:
        goal.state, goal.ended_at = state, self.now
        self._ended.append(goal)
        if goal is self.current:
            self.current = self.ending = None
