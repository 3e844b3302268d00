"""The loop of :mod:`rce_fleet.tasks.travel`: lengths of the ways from all cells to some, side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rce_fleet.compiled import helper, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

LANES = 16
"""Goals whose lengths are found side by side, with one instruction of the processor for some of them."""


def _measure_scipy(indptr: Ints, neighbours: Ints, costs: Floats, goals: Ints) -> NDArray[np.float32]:
    from scipy.sparse import csr_array  # long to load, needed only where nothing is compiled
    from scipy.sparse.csgraph import dijkstra

    graph: Any = csr_array((costs, neighbours, indptr), shape=(len(indptr) - 1, len(indptr) - 1))
    return np.asarray(dijkstra(graph, indices=goals), np.float32).reshape(len(goals), -1)


@helper
def _sweep_ways(
    indptr: Ints, neighbours: Ints, costs: Floats, block: Floats, lowered: NDArray[np.uint8], forwards: bool
) -> bool:
    """Lower lengths along the edges of the nodes that were lowered; return whether a node was."""
    nodes = len(indptr) - 1
    is_open = False
    for place in range(nodes):
        node = place if forwards else nodes - 1 - place
        if not lowered[node]:
            continue
        lowered[node] = 0
        here = block[node]
        for edge in range(indptr[node], indptr[node + 1]):
            there = block[neighbours[edge]]
            cost = costs[edge]
            better = np.int64(0)
            for lane in range(LANES):
                through, now = here[lane] + cost, there[lane]
                there[lane] = through if through < now else now  # noqa: FURB136 - min() is not vectorized
                better |= np.int64(through < now)
            if better:
                lowered[neighbours[edge]] = 1
                is_open = True
    return is_open


@kernel("float32[:, ::1](int32[::1], int32[::1], float64[::1], int32[::1])", numpy=_measure_scipy)
def measure_ways(indptr: Ints, neighbours: Ints, costs: Floats, goals: Ints) -> NDArray[np.float32]:
    """Return the length of the shortest way from each node to each goal.

    Sweeps go through the nodes forwards and backwards in turn, from those whose lengths were lowered, until
    there are none (Bellman, "On a routing problem", 1958). Both forms add lengths up from the goal, so that
    they return the same numbers.

    Args:
        indptr: The graph with its edges reversed, in compressed rows.
        neighbours: See above.
        costs: Lengths of the edges, not negative.
        goals: Nodes.

    Returns:
        Lengths, shape (goals, nodes); ``inf``: there is no way.
    """
    nodes = len(indptr) - 1
    found = np.empty((len(goals), nodes), np.float32)
    block = np.empty((nodes, LANES))
    lowered = np.zeros(nodes, np.uint8)
    for first in range(0, len(goals), LANES):
        count = min(LANES, len(goals) - first)
        block[:] = np.inf
        for lane in range(count):
            block[goals[first + lane], lane] = 0.0
            lowered[goals[first + lane]] = 1
        forwards = True
        while _sweep_ways(indptr, neighbours, costs, block, lowered, forwards):
            forwards = not forwards
        for node in range(nodes):
            for lane in range(count):
                found[first + lane, node] = block[node, lane]
    return found
