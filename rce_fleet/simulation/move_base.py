"""The simulated robot's ``move_base``: accepts goals, drives to them, stops in front of obstacles.

It behaves like an actionlib server (:mod:`rce_fleet.simulation.goal_list`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.coordination.move_client import GoalState
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.navigation import DriveLimits, Navigator
from rce_fleet.simulation.goal_list import Goal, GoalList
from rce_fleet.simulation.obstacles import blocked_cell, clear_ahead

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.lidar import Floats

SIGHT = 1.2
"""How far ahead a robot looks for blocked cells, metres."""
MARGIN = 0.15
"""Width of a cell's border in which lidar hits may belong to the next cell, metres."""
STUCK_TIMEOUT = 3.0
"""Seconds after which a robot aborts its goal because of an obstacle that it cannot assign to a cell."""


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
        self._goals = GoalList()
        self._stuck_for = 0.0

    @property
    def goals(self) -> list[Goal]:
        """The goals in the status list: the current one, and those that ended recently."""
        return self._goals.goals

    def take_ended(self) -> list[Goal]:
        """Return the goals that ended since the last call."""
        return self._goals.take_ended()

    def accept(self, goal_id: str, stamp: float, x: float, y: float) -> None:
        """Accept a goal; do nothing if it is known already."""
        if self._goals.accept(goal_id, stamp, x, y):
            self.blocked = ()
            self._stuck_for = 0.0
            self._navigator.follow([(x, y)])

    def cancel(self, goal_id: str, stamp: float) -> None:
        """Cancel the goal of this id and goals with a time up to ``stamp``; all if neither is given."""
        if self._goals.cancel(goal_id, stamp):
            self._navigator.stop()

    def limit_speed(self, speed: float) -> None:
        """Drive at most at a speed from now on, metres per second; infinity: not limited."""
        self._navigator.speed_limit = speed

    def update(self, now: float, pose: Pose, points: Floats) -> Twist:
        """Return the speeds to drive until the next update.

        Args:
            now: Time, seconds.
            pose: The robot's estimated pose.
            points: Points of its last lidar scan, shape (N, 2), metres in the map.
        """
        goals = self._goals
        dt, goals.now = max(now - goals.now, 0.0) if goals.now else 0.0, now
        goal = goals.current
        if goal is not None and goals.ending is None:
            cell = blocked_cell(self._grid, points, pose, goal.place, sight=SIGHT, margin=MARGIN)
            if cell is not None:
                self.blocked = (cell,)
                self._brake(GoalState.ABORTED)
        clear = clear_ahead(points, pose, self._radius) if len(points) else np.inf
        twist = self._navigator.update(pose, dt, clear)
        self._judge(dt)
        goals.forget()
        return twist

    def _judge(self, dt: float) -> None:
        """End the goal if the robot reached it, or cannot go on."""
        if self._goals.current is None:
            return
        if self._navigator.done:
            self._goals.end()
        elif self._navigator.standing:
            self._stuck_for += dt
            if self._stuck_for > STUCK_TIMEOUT:
                self._brake(GoalState.ABORTED)
        else:
            self._stuck_for = 0.0

    def _brake(self, ending: GoalState) -> None:
        self._goals.ending = ending
        self._navigator.stop()
