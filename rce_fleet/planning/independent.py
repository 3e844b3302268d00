"""The planner ``dijkstra``: each robot's shortest path, without regard to the others.

This is the planner of the paper that the fleet system began with, and the baseline of its benchmarks. The
paths of two robots may cross in one step: what carries out the plan hands out cells one robot at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.fields import UNREACHABLE, distance_fields
from rce_fleet.planning.planner import JointPlan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph
    from rce_fleet.planning.planner import PlanningProblem


class DijkstraPlanner:
    """Plans each robot alone; see the module."""

    def plan(self, problem: PlanningProblem) -> JointPlan:
        """Return each robot's cheapest path; a robot without one stays at its start."""
        graph = problem.graph
        own = problem.own_costs or {}
        fields = distance_fields(graph, problem.goals, problem.forbidden, problem.starts, own)
        ends = zip(fields, problem.starts, problem.goals, strict=True)
        paths = [
            _descend(graph, own.get(robot, graph.costs), field, int(start), int(goal))
            for robot, (field, start, goal) in enumerate(ends)
        ]
        last = max(map(len, paths), default=1)
        cells = np.empty((last, len(paths)), dtype=np.int32)
        for robot, path in enumerate(paths):
            cells[: len(path), robot] = path
            cells[len(path) :, robot] = path[-1]
        complete = bool((cells[-1] == problem.goals).all())
        return JointPlan(cells, complete, conflict_free=False)


def _descend(
    graph: PlanningGraph, costs: NDArray[np.int32], field: NDArray[np.int32], start: int, goal: int
) -> list[int]:
    """Follow a distance field from ``start``; among equal nodes the path goes straight on if it can."""
    path = [start]
    if field[start] == UNREACHABLE:
        return path
    step = 0
    while path[-1] != goal:
        here = path[-1]
        first, end = graph.indptr[here], graph.indptr[here + 1]
        ahead = min(
            range(first, end),
            key=lambda edge: (
                int(costs[edge]) + int(field[graph.neighbours[edge]]),
                int(graph.neighbours[edge]) - here != step,
            ),
        )
        step = int(graph.neighbours[ahead]) - here
        path.append(int(graph.neighbours[ahead]))
    return path
