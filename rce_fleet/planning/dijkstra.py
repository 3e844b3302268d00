"""Dijkstra's shortest paths on the grid."""

from __future__ import annotations

import heapq
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.planning.grid import GridMap


def distances(grid: GridMap, goal: int, weights: Sequence[float] | None = None) -> list[float]:
    """Cost of the cheapest way to ``goal``, for every cell.

    Args:
        grid: The map; blocked cells cannot be entered.
        goal: Where the ways end.
        weights: Cost of leaving each cell, positive; 1 for all by default.

    Returns:
        One number a cell; ``inf`` where no way leads to the goal. A blocked goal is reached from nowhere.
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
    """Count steps from the goal outwards: with equal weights a queue does what a heap does."""
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
    """The cheapest way from ``start`` to ``goal``, both included; ``None`` if there is none.

    Among equal ways the one is taken that keeps its direction longest, because every turn costs a robot time.
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
