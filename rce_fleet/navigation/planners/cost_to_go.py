"""The cost of the cheapest way from cells to a goal: a field over a costmap, in whole numbers.

As the costs are whole numbers, the field does not depend on the order in which cells are visited: the
compiled loop (Dial's algorithm, a queue of buckets by cost) and the numpy form (scipy's Dijkstra) give the
same field, and the same path is read from it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from rce_fleet.compiled import kernel
from rce_fleet.navigation.costmap.costs import INSCRIBED, UNKNOWN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]
    Steps = NDArray[np.int16]

UNREACHED = 1 << 62
"""The cost of cells from which the goal cannot be reached, or that are farther from it than the start."""
NEUTRAL_COST = 50
"""Cost of a step to a cell without an obstacle near; navfn's ``COST_NEUTRAL``."""
_PER_COST = (4, 5)
"""What a cell's cost adds to a step, as a fraction: 0.8, navfn's ``COST_FACTOR``."""
_DIAGONAL = (181, 7)
"""A diagonal step's cost in straight ones: 181 / 2**7, 0.01 % below the square root of 2."""


def steps_of(costs: NDArray[np.uint8], *, allow_unknown: bool = True) -> Steps:
    """Return the cost of a straight step from each cell, with a border of cells that cannot be entered.

    Args:
        costs: Shape (rows, columns).
        allow_unknown: Unknown cells can be entered, at the highest cost.

    Returns:
        Shape (rows + 2, columns + 2); 0 where a cell cannot be entered.
    """
    table = (NEUTRAL_COST + np.arange(256) * _PER_COST[0] // _PER_COST[1]).astype(np.int16)
    table[INSCRIBED:] = 0
    table[UNKNOWN] = table[INSCRIBED - 1] if allow_unknown else 0
    return np.pad(table[costs], 1)


def _spread_numpy(steps: Steps, goal: int, stop: int) -> Ints:
    """Compute the field with scipy."""
    columns = steps.shape[1]
    flat = steps.reshape(-1)
    cells = np.flatnonzero(flat).astype(np.int32)
    origins, targets = [], []
    for offset in (1, -1, columns, -columns):
        into = cells[flat[cells + offset] > 0]
        origins.append(into)
        targets.append(into + offset)
    straight = sum(map(len, origins))
    for down in (columns, -columns):
        for across in (1, -1):
            open_ones = (
                (flat[cells + down + across] > 0) & (flat[cells + down] > 0) & (flat[cells + across] > 0)
            )
            into = cells[open_ones]
            origins.append(into)
            targets.append(into + down + across)
    edges = np.concatenate(origins), np.concatenate(targets)
    del origins, targets  # on a large map, edges are most of the memory
    weights = flat[edges[1]].astype(np.float64)
    weights[straight:] = np.floor(weights[straight:] * _DIAGONAL[0] / (1 << _DIAGONAL[1]))
    graph = csr_array((weights, edges), shape=(len(flat), len(flat)))
    del weights, edges
    found = dijkstra(graph, indices=goal)
    field = np.full(len(flat), UNREACHED, np.int64)
    limit = found[stop] if stop >= 0 else np.inf
    reached = np.isfinite(found) & (found <= limit)
    field[reached] = found[reached].astype(np.int64)
    return field.reshape(steps.shape)


@kernel("int64[:,::1](int16[:,::1], int64, int64)", numpy=_spread_numpy)
def spread(steps: Steps, goal: int, stop: int) -> Ints:  # noqa: C901, PLR0912, PLR0915 - one loop, to compile
    """Return the cost of the cheapest way from each cell to the goal, shape as ``steps``.

    A way makes straight and diagonal steps; a diagonal one only where both cells beside it can be entered.

    Args:
        steps: Cost of a straight step from each cell; 0: it cannot be entered, as all cells of the border.
        goal: Index of the goal in the flattened array; it can be entered.
        stop: Index of a cell: costs above its cost are not computed; -1: all.
    """
    columns = steps.shape[1]
    flat = steps.reshape(steps.size)
    count = len(flat)
    buckets = ((np.int64(flat.max()) * 181) >> 7) + 1
    field = np.full(count, 1 << 62, np.int64)
    # 32 bits for indices of cells: with 64, a plan on a large map takes twice the memory.
    head = np.full(buckets, -1, np.int32)
    before = np.full(count, -1, np.int32)
    after = np.full(count, -1, np.int32)
    offsets = np.array((1, -1, columns, -columns, columns + 1, columns - 1, 1 - columns, -1 - columns))
    beside = np.array((0, 0, 0, 0, 1, -1, 1, -1))
    field[goal] = 0
    head[0] = np.int32(goal)
    waiting = 1
    cost = 0
    limit = 1 << 62
    while waiting > 0 and cost <= limit:
        bucket = cost % buckets
        cell = int(head[bucket])
        if cell < 0:
            cost += 1
            continue
        head[bucket] = after[cell]
        if after[cell] >= 0:
            before[after[cell]] = -1
        waiting -= 1
        if cell == stop:
            limit = cost
        for way in range(8):
            other = cell + offsets[way]
            step = int(flat[other])  # not of 16 bits: a diagonal one is computed from it
            if step == 0:
                continue
            if beside[way] != 0:
                if flat[cell + beside[way]] == 0 or flat[cell + offsets[way] - beside[way]] == 0:
                    continue
                step = (step * 181) >> 7
            reached = cost + step
            if reached >= field[other]:
                continue
            if field[other] < 1 << 62:
                old = field[other] % buckets
                if before[other] >= 0:
                    after[before[other]] = after[other]
                else:
                    head[old] = after[other]
                if after[other] >= 0:
                    before[after[other]] = before[other]
                waiting -= 1
            field[other] = reached
            new = reached % buckets
            before[other] = -1
            after[other] = head[new]
            if head[new] >= 0:
                before[head[new]] = np.int32(other)
            head[new] = np.int32(other)
            waiting += 1
    for cell in range(count):
        if field[cell] > limit:
            field[cell] = 1 << 62
    return field.reshape(steps.shape)


def descend(field: Ints, steps: Steps, start: int) -> list[int]:
    """Return the cells of a cheapest way from ``start`` to the field's goal, as indices of flattened arrays.

    Raises:
        ValueError: The goal cannot be reached from the start.
    """
    columns = field.shape[1]
    costs, step = field.reshape(-1), steps.reshape(-1)
    here, left = start, int(costs[start])
    if left >= UNREACHED:
        raise ValueError("the goal cannot be reached from the start")
    way = [here]
    straight = (1, -1, columns, -columns)
    diagonal = [(down, across) for down in (columns, -columns) for across in (1, -1)]
    while left > 0:
        price = int(step[here])
        slanting = (price * _DIAGONAL[0]) >> _DIAGONAL[1]
        for down, across in diagonal:
            there = here + down + across
            if costs[there] == left - slanting and step[here + down] and step[here + across]:
                here, left = there, left - slanting
                break
        else:
            here += next(offset for offset in straight if costs[here + offset] == left - price)
            left -= price
        way.append(here)
    return way
