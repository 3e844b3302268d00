"""Guidance: costs of moves that make robots flow, made from the map.

In an aisle that is one cell wide robots cannot pass each other. Costs that prefer one direction in each
aisle, alternating between parallel aisles, keep opposite streams apart (Cohen, Uras and Koenig,
"Feasibility Study: Using Highways for Bounded-Suboptimal Multi-Agent Path Finding", 2015). The other
direction stays possible.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.graph import MAX_COST, PlanningGraph

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]

DOWN, LEFT, RIGHT, UP = range(4)
"""Columns of a table of costs: moves to row - 1, column - 1, column + 1, row + 1."""
_MIN_AISLE = 3
"""Cells of the shortest aisle."""


def guided(graph: PlanningGraph, *, against: int = 2) -> PlanningGraph:
    """Return the graph of a grid with costs that prefer one direction in every aisle.

    An aisle is a straight line of nodes with walls, or the edge of the map, on both sides. Aisles of one row
    or column have one direction; the next row or column with aisles has the opposite one. A move whose
    opposite is closed keeps its cost: no robot comes from there. A graph that is not of a grid, or has no
    aisles, is returned as it is.

    Args:
        graph: The graph; its costs are multiplied.
        against: Factor of moves against an aisle's direction.
    """
    if not graph.columns:
        return graph
    free = np.zeros(len(graph), dtype=bool)
    free[graph.neighbours] = True
    factors = aisle_factors(free.reshape(-1, graph.columns), against=against).reshape(-1, 4)
    sources = np.repeat(np.arange(len(graph)), np.diff(graph.indptr))
    offsets = {-graph.columns: DOWN, -1: LEFT, 1: RIGHT, graph.columns: UP}
    directions = np.zeros(len(sources), np.int32)
    for offset, direction in offsets.items():
        directions[graph.neighbours - sources == offset] = direction
    is_open = np.zeros((len(graph), len(offsets)), dtype=bool)
    is_open[sources, directions] = True
    is_two_way = is_open[graph.neighbours, UP - directions]
    factor = np.where(is_two_way, factors[sources, directions], 1)
    if (factor == 1).all():
        return graph
    costs = np.minimum(graph.costs * factor, MAX_COST)
    return PlanningGraph(graph.indptr, graph.neighbours, costs, graph.columns)


def aisle_factors(free: NDArray[np.bool_], *, against: int) -> Ints:
    """Return factors of moves that prefer one direction in every aisle; see :func:`guided`.

    Args:
        free: Cells that can be entered, shape (rows, columns).
        against: Factor of moves against an aisle's direction.

    Returns:
        shape (rows, columns, 4).
    """
    factors = np.ones((*free.shape, 4), dtype=np.int32)
    for axis, (back, ahead) in enumerate(((LEFT, RIGHT), (DOWN, UP))):
        lines = free if axis == 0 else free.T
        padded = np.pad(lines, ((1, 1), (0, 0)))
        aisle = lines & ~padded[:-2] & ~padded[2:]
        turned = False
        for line, cells in enumerate(aisle):
            ends = np.flatnonzero(np.diff(np.concatenate(([0], cells, [0]))))
            runs = [(a, b) for a, b in zip(ends[::2], ends[1::2], strict=True) if b - a >= _MIN_AISLE]
            for first, last in runs:
                part = np.s_[line, first:last] if axis == 0 else np.s_[first:last, line]
                factors[part][..., ahead if turned else back] = against
            turned ^= bool(runs)
    return factors
