"""Dijkstra's shortest paths on the grid."""

from __future__ import annotations

import heapq
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.planning.grid import GridMap


def distances(grid: GridMap, goal: int, weights: Sequence[float] | None = None) -> list[float]:
    """Return the cost of the cheapest path to ``goal``, for every cell.

    Args:
        grid: The map; blocked cells cannot be entered.
        goal: Cell where the paths end.
        weights: Cost of leaving each cell, positive; 1 for all by default.

    Returns:
        One number per cell; ``inf`` if no path leads to the goal. A blocked goal cannot be reached.
    """
    cost = [inf] * len(grid)
    if goal in grid.blocked:
        return cost
    cost[goal] = 0.0
    if weights is None:
        _spread(grid, goal, cost)
        return cost
    heap = [(0.0, goal)]
    while heap:
        reached, cell = heapq.heappop(heap)
        if reached > cost[cell]:
            continue
        for other in grid.neighbours[cell]:
            through = reached + weights[other]
            if through < cost[other]:
                cost[other] = through
                heapq.heappush(heap, (through, other))
    return cost


def _spread(grid: GridMap, goal: int, cost: list[float]) -> None:
    """Return the steps from the goal, by breadth-first search: with equal weights no heap is needed."""
    ring, steps = [goal], 0.0
    while ring:
        steps += 1.0
        outer = []
        for cell in ring:
            for other in grid.neighbours[cell]:
                if cost[other] > steps:
                    cost[other] = steps
                    outer.append(other)
        ring = outer


def shortest_path(
    grid: GridMap, start: int, goal: int, weights: Sequence[float] | None = None
) -> list[int] | None:
    """Return the cheapest path from ``start`` to ``goal``, both included; ``None`` if there is none.

    Among equal paths it prefers the one that keeps its direction longest: every turn costs a robot time.
    """
    cost = distances(grid, goal, weights)
    if cost[start] == inf:
        return None
    path = [start]
    step = 0
    while path[-1] != goal:
        here = path[-1]
        ahead = min(grid.neighbours[here], key=lambda other: (cost[other], other - here != step))
        step = ahead - here
        path.append(ahead)
    return path
