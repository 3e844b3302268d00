"""The simulated robot's ``move_base``: accepts goals, drives to them, stops in front of obstacles.

It behaves like an actionlib server: a new goal replaces the current one; a cancellation names a goal or a
time, and goals with an earlier time stamp are recalled even if they arrive later.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.coordination.move_client import GoalState
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.navigation import DriveLimits, Navigator
from rce_fleet.simulation.obstacles import blocked_cell, clear_ahead

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.lidar import Floats

REMEMBER = 5.0
"""Seconds for which a finished goal stays in the status list."""
SIGHT = 1.2
"""How far ahead a robot looks for blocked cells, metres."""
MARGIN = 0.15
"""Width of a cell's border in which lidar hits may belong to the next cell, metres."""
STUCK_TIMEOUT = 3.0
"""Seconds after which a robot aborts its goal because of an obstacle that it cannot assign to a cell."""


@dataclass(slots=True)
class Goal:
    """A navigation goal: id, time stamp (seconds), place (metres) and state."""

    id: str
    stamp: float
    place: tuple[float, float]
    state: GoalState = GoalState.ACTIVE
    ended_at: float = 0.0


class SimulatedMoveBase:
    """Drives one robot to its goals.

    Args:
        grid: The map.
        radius: Radius of the robot's hull, metres.
        limits: Speeds and accelerations of the robot.

    Attributes:
        blocked: Cells that the robot found blocked on the way to its last goal.
    """

    def __init__(self, grid: GridMap, radius: float, limits: DriveLimits | None = None) -> None:
        self.blocked: tuple[int, ...] = ()
        self._grid = grid
        self._radius = radius
        self._navigator = Navigator(limits)
        self._goals: dict[str, Goal] = {}
        self._current: Goal | None = None
        self._ending: GoalState | None = None
        self._ended: list[Goal] = []
        self._recalled_until = float("-inf")
        self._stuck_for = 0.0
        self._now = 0.0

    @property
    def goals(self) -> list[Goal]:
        """The goals in the status list: the current one, and those that ended recently."""
        return list(self._goals.values())

    def take_ended(self) -> list[Goal]:
        """Return the goals that ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def accept(self, goal_id: str, stamp: float, x: float, y: float) -> None:
        """Accept a goal; do nothing if it is known already."""
        if goal_id in self._goals:
            return
        goal = self._goals[goal_id] = Goal(goal_id, stamp, (x, y))
        if stamp <= self._recalled_until:
            self._end(goal, GoalState.RECALLED)
            return
        if self._current is not None:
            self._end(self._current, GoalState.PREEMPTED)
        self._current, self._ending = goal, None
        self.blocked = ()
        self._stuck_for = 0.0
        self._navigator.follow([goal.place])

    def cancel(self, goal_id: str, stamp: float) -> None:
        """Cancel the goal of this id and goals with a time up to ``stamp``; all if neither is given."""
        if stamp:
            self._recalled_until = max(self._recalled_until, stamp)
        goal = self._current
        if goal is None or goal.state is not GoalState.ACTIVE:
            return
        if goal.id == goal_id or goal.stamp <= stamp or (not goal_id and not stamp):
            goal.state = GoalState.PREEMPTING
            self._brake(GoalState.PREEMPTED)

    def update(self, now: float, pose: Pose, points: Floats) -> Twist:
        """Return the speeds to drive until the next update.

        Args:
            now: Time, seconds.
            pose: The robot's estimated pose.
            points: Points of its last lidar scan, shape (N, 2), metres in the map.
        """
        dt, self._now = max(now - self._now, 0.0) if self._now else 0.0, now
        goal = self._current
        if goal is not None and self._ending is None:
            cell = blocked_cell(self._grid, points, pose, goal.place, sight=SIGHT, margin=MARGIN)
            if cell is not None:
                self.blocked = (cell,)
                self._brake(GoalState.ABORTED)
        clear = clear_ahead(points, pose, self._radius) if len(points) else np.inf
        twist = self._navigator.update(pose, dt, clear)
        self._judge(dt)
        self._forget(now)
        return twist

    def _judge(self, dt: float) -> None:
        """End the goal if the robot reached it, or cannot go on."""
        goal = self._current
        if goal is None:
            return
        if self._navigator.done:
            self._end(goal, self._ending or GoalState.SUCCEEDED)
        elif self._navigator.standing:
            self._stuck_for += dt
            if self._stuck_for > STUCK_TIMEOUT:
                self._brake(GoalState.ABORTED)
        else:
            self._stuck_for = 0.0

    def _brake(self, ending: GoalState) -> None:
        self._ending = ending
        self._navigator.stop()

    def _end(self, goal: Goal, state: GoalState) -> None:
        goal.state, goal.ended_at = state, self._now
        self._ended.append(goal)
        if goal is self._current:
            self._current = self._ending = None

    def _forget(self, now: float) -> None:
        for goal in [goal for goal in self._goals.values() if goal.state.over]:
            if now - goal.ended_at > REMEMBER:
                del self._goals[goal.id]
