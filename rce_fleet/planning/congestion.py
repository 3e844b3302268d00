"""Guidance learned from congestion: edges where robots waited become dearer, and robots spread out.

After Chen et al., "Traffic Flow Optimisation for Lifelong Multi-Agent Path Finding" (2024), who raise costs
where many paths lead; here costs rise where robots really waited, and fall again with time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.graph import MAX_COST, PlanningGraph

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class CongestionSettings:
    """Parameters of guidance from congestion.

    Attributes:
        half_life: Steps after which a wait counts half.
        most: Factor of an edge's cost at most.
        weight: By how much a mean of one waiting robot raises the factor.
        units: Units in which a cost of 1 is counted, so that factors can be fractions.
    """

    half_life: float = 100.0
    most: float = 2.0
    weight: float = 1.0
    units: int = 4


class Congestion:
    """Counts of waiting at each edge, with decay, and the costs that follow from them.

    ::

        congestion = Congestion(graph)
        congestion.observe(waiting=[12, 40], wanted=[13, 41])  # once a step
        graph = congestion.graph()  # from time to time; a planner's distances have to be computed anew

    Args:
        graph: Nodes and edges, with the costs that an edge without waiting robots has.
        settings: See there.
    """

    def __init__(self, graph: PlanningGraph, settings: CongestionSettings | None = None) -> None:
        self._graph = graph
        self._settings = settings or CongestionSettings()
        self._decay = 0.5 ** (1.0 / self._settings.half_life)
        self._waits = np.zeros(len(graph.neighbours))

    def observe(self, waiting: Ints | list[int], wanted: Ints | list[int]) -> None:
        """Count the robots of one step that waited.

        Args:
            waiting: Nodes of robots that stayed though they were to move, shape (robots,).
            wanted: The node that each of them was to enter, beside its own; others are not counted.
        """
        self._waits *= self._decay
        indptr, neighbours = self._graph.indptr, self._graph.neighbours
        for here, there in zip(np.asarray(waiting).tolist(), np.asarray(wanted).tolist(), strict=True):
            edges = np.arange(indptr[here], indptr[here + 1])
            self._waits[edges[neighbours[edges] == there]] += 1.0 - self._decay

    @property
    def waits(self) -> NDArray[np.float64]:
        """Mean number of robots that wait for each edge, shape (edges,)."""
        return self._waits.copy()

    def graph(self) -> PlanningGraph:
        """Return the graph with its present costs; all costs are counted in ``units``."""
        settings = self._settings
        factors = np.minimum(1.0 + settings.weight * self._waits, settings.most)
        costs = np.minimum(np.rint(self._graph.costs * factors * settings.units), MAX_COST)
        return PlanningGraph(
            self._graph.indptr, self._graph.neighbours, costs.astype(np.int32), self._graph.columns
        )
