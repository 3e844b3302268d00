"""A planning problem without the nodes that no robot can be in.

Most cells of a warehouse are shelves. Without them tables of distances are smaller, and what belongs together
is closer in memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.graph import PlanningGraph

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.planning.planner import PlanningProblem

    Ints = NDArray[np.int32]


class Compaction:
    """The problem with its nodes numbered anew.

    Attributes:
        graph: The nodes that can be entered, or are starts or goals.
        starts: Start of each robot.
        goals: Goal of each robot.
        forbidden: For some robots the nodes that only these must not enter.
        own_costs: For some robots the cost of every edge.
    """

    def __init__(self, problem: PlanningProblem) -> None:
        graph = problem.graph
        kept = np.zeros(len(graph), dtype=bool)
        kept[graph.neighbours] = True
        kept[problem.starts] = True
        kept[problem.goals] = True
        self._kept = kept
        self._edges = np.repeat(kept, np.diff(graph.indptr))
        self._original = np.flatnonzero(kept).astype(np.int32)
        self._number = np.full(len(graph), -1, np.int32)
        self._number[self._original] = np.arange(len(self._original))
        self.graph = self.compact(graph)
        self.starts = self._number[problem.starts]
        self.goals = self._number[problem.goals]
        self.forbidden = {
            robot: frozenset(self._number[[node for node in nodes if kept[node]]].tolist())
            for robot, nodes in (problem.forbidden or {}).items()
        }
        alike = {id(costs): self.edges(costs) for costs in (problem.own_costs or {}).values()}
        self.own_costs = {robot: alike[id(costs)] for robot, costs in (problem.own_costs or {}).items()}

    def edges(self, values: Ints) -> Ints:
        """Return those of the values of a graph's edges that belong to the kept ones."""
        kept: Ints = values[self._edges]
        return kept

    def own_costs_on(self, guide: PlanningGraph) -> dict[int, Ints]:
        """Return the own costs with the factors of a graph that has guidance and the same edges."""
        if guide is self.graph or not self.own_costs:
            return self.own_costs
        factor = guide.costs // self.graph.costs
        alike = {id(costs): costs * factor for costs in self.own_costs.values()}
        return {robot: alike[id(costs)] for robot, costs in self.own_costs.items()}

    def compact(self, graph: PlanningGraph) -> PlanningGraph:
        """Return a graph with the same edges, numbered anew."""
        counts = np.diff(graph.indptr)
        edges = self._edges
        indptr = np.concatenate(([0], np.cumsum(counts[self._kept]))).astype(np.int32)
        return PlanningGraph(indptr, self._number[graph.neighbours[edges]], graph.costs[edges])

    def original(self, nodes: Ints) -> Ints:
        """Return the problem's numbers of these nodes."""
        return self._original[nodes]
