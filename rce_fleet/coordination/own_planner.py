"""A planner of another package: when it makes the plans, and whether they can be carried out. Pure."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.planner import BUILT_IN_PLANNERS, DEFAULT_PLANNER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.planner import JointPlan, PlanningProblem

PAUSE = 60.0
"""Seconds for which the default planner makes all plans after another one failed."""
_PAUSE_FACTOR = 10.0
"""After a plan that took long to fail, robots drive for so many times as long as they waited for it."""


class OwnPlanner:
    """Decides whether a planner of another package is asked, or the default one in its place.

    Args:
        name: Name of the planner that the settings choose.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._is_own = name not in BUILT_IN_PLANNERS
        self._from = -inf

    def is_asked(self, now: float) -> bool:
        """Return whether such a planner is chosen and makes the plans: then all robots' paths are its own."""
        return self._is_own and now >= self._from

    def name_at(self, now: float) -> str:
        """Return the name of the planner that makes the next plan for all."""
        return self._name if self.is_asked(now) else DEFAULT_PLANNER

    def note_failure(self, asked_at: float, now: float) -> None:
        """Let the default planner make the plans for a while.

        Args:
            asked_at: When the plan that failed was asked for, seconds.
            now: Time, seconds.
        """
        self._from = now + max(PAUSE, _PAUSE_FACTOR * (now - asked_at))


def find_fault(joint: JointPlan, problem: PlanningProblem, grid: GridMap, robots: Sequence[str]) -> str:
    """Return why a plan cannot be carried out, in words; empty: it can.

    Moves that zones close are no fault: a route ends before them. Conflicts are none in a plan that does not
    promise to be free of them.

    Args:
        joint: The plan.
        problem: What was asked for.
        grid: The map that the problem's graph was made from.
        robots: Names of the robots.
    """
    cells = joint.cells
    if cells.dtype.kind not in "iu":
        return f"the cells of its plan are {cells.dtype}, not whole numbers"
    if cells.ndim != len(("step", "robot")) or not len(cells) or cells.shape[1] != len(robots):
        return f"its plan has the shape {cells.shape} instead of (steps + 1, {len(robots)} robots)"
    if not joint.complete and (cells == problem.starts).all():
        return "it found no plan: all robots stay where they are"
    paths: list[list[int]] = cells.T.tolist()
    goals = problem.goals.tolist() if joint.complete else None
    for fault in check_plan(grid, paths, starts=problem.starts.tolist(), goals=goals, rotations=False):
        if joint.conflict_free or len(fault.robots) == 1:
            names = ", ".join(f"robot {robot} is {robots[robot]}" for robot in fault.robots)
            return f"{fault} ({names})"
    for robot, forbidden in (problem.forbidden or {}).items():
        wrong = np.isin(cells[:, robot], list(forbidden - {paths[robot][0]}))
        if wrong.any():
            step = int(wrong.argmax())
            cell = paths[robot][step]
            return f"step {step}: robot {robot} enters cell {cell}, which it may not (it is {robots[robot]})"
    return ""
