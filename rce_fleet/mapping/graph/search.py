"""Branch and bound over shifts and turns of a scan: the inner loop of correlative matching.

Scores are whole numbers and ties have an order, so both forms return the same pose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCALE = 1024
"""Penalties are counted in parts of a score of one."""
BATCH = 256
"""The numpy search looks at the children of so many nodes at once."""
QUARTERS = np.array(((0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 1)))
"""Where the four children of a node are: turn, row, column in half its size."""


def _search_numpy(
    levels: NDArray[np.uint8],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    reach: int,
    turn_costs: NDArray[np.int64],
    weight: int,
    excluded: NDArray[np.int64],
    floor: int,
) -> NDArray[np.int64]:
    """Return what :func:`search` returns.

    Nodes are searched in batches of the same level, the batch with the greatest bounds first.
    """

    def bounds_of(level: int, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        turn, row, column = nodes.T
        bounds = _sums(levels[level], columns, rows, turn, row, column)
        bounds -= turn_costs[turn]
        bounds -= _shift_cost(row, level, reach, weight) + _shift_cost(column, level, reach, weight)
        return bounds

    top = _top_level(len(levels), reach)
    starts = np.arange(-reach, reach + 1, 1 << top)
    grid = np.meshgrid(np.arange(len(columns)), starts, starts, indexing="ij")
    nodes = np.stack([part.ravel() for part in grid], axis=-1).astype(np.int64)
    best = (floor - 1, -1, 0, 0)
    batches = [(top, nodes, bounds_of(top, nodes))]
    while batches:
        level, nodes, bounds = batches.pop()
        alive = bounds >= max(best[0], floor)
        nodes, bounds = nodes[alive], bounds[alive]
        if level == 0:
            best = _best_leaf(best, nodes, bounds, excluded)
            continue
        order = np.argsort(-bounds, kind="stable")
        if len(order) > BATCH:
            batches.append((level, nodes[order[BATCH:]], bounds[order[BATCH:]]))
        nodes = nodes[order[:BATCH]]
        half = 1 << (level - 1)
        children = (nodes[:, None] + half * QUARTERS).reshape(-1, 3)
        children = children[(children[:, 1:] <= reach).all(1)]
        if len(children):
            batches.append((level - 1, children, bounds_of(level - 1, children)))
    return np.array(best if best[1] >= 0 else (-1, -1, 0, 0), np.int64)


def _best_leaf(
    best: tuple[int, int, int, int],
    nodes: NDArray[np.int64],
    scores: NDArray[np.int64],
    excluded: NDArray[np.int64],
) -> tuple[int, int, int, int]:
    """Return the best of some leaves and the best one so far; of equal ones the first in order."""
    apart = np.abs(nodes - excluded[:3])
    kept = (apart > excluded[[3, 4, 4]]).any(1)
    nodes, scores = nodes[kept], scores[kept]
    if not len(scores) or scores.max() < best[0]:
        return best
    ties = nodes[scores == scores.max()]
    turn, row, column = ties[np.lexsort(ties.T[::-1])[0]].tolist()
    found = (int(scores.max()), turn, row, column)
    if best[1] >= 0 and found[0] == best[0]:
        return min(best, found)
    return found if found[0] > best[0] else best


def _sums(
    grid: NDArray[np.uint8],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    turn: NDArray[np.intp],
    row: NDArray[np.intp],
    column: NDArray[np.intp],
) -> NDArray[np.int64]:
    height, width = grid.shape
    y, x = rows[turn] + row[:, None], columns[turn] + column[:, None]
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    values = grid.ravel()[np.where(inside, y * width + x, 0)]
    sums: NDArray[np.int64] = np.where(inside, values, 0).sum(1, dtype=np.int64)
    return sums


def _shift_cost(start: NDArray[np.intp], level: int, reach: int, weight: int) -> NDArray[np.int64]:
    """Return the least cost of the shifts that a node covers along one axis."""
    end = start + (1 << level) - 1
    nearest = np.where(start > 0, start, np.where(end < 0, -end, 0)).astype(np.int64)
    return (weight * nearest**2) // reach**2 // SCALE


def _top_level(count: int, reach: int) -> int:
    """Return the level at which the search begins: the window is a few of its nodes wide."""
    top = 0
    while top + 1 < count and (1 << (top + 1)) <= reach:
        top += 1
    return top


@helper
def _bound(
    grid: NDArray[np.uint8],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    row: int,
    column: int,
    size: int,
    reach: int,
    weight: int,
) -> int:
    """Return the sum of a level over shifted cells, cells outside as 0, less the least cost of the shifts."""
    height, width = grid.shape
    total = 0
    for point in range(len(columns)):
        y = rows[point] + row
        x = columns[point] + column
        if 0 <= y < height and 0 <= x < width:
            total += int(grid[y, x])
    end = row + size - 1
    nearest_row = row if row > 0 else (-end if end < 0 else 0)
    end = column + size - 1
    nearest_column = column if column > 0 else (-end if end < 0 else 0)
    total -= (weight * nearest_row * nearest_row) // (reach * reach) // SCALE
    total -= (weight * nearest_column * nearest_column) // (reach * reach) // SCALE
    return total


@helper
def _take_leaf(
    best: NDArray[np.int64], excluded: NDArray[np.int64], score: int, turn: int, row: int, column: int
) -> None:
    """Keep a leaf if it is better than the best one, or as good and earlier."""
    if (
        abs(turn - excluded[0]) <= excluded[3]
        and abs(row - excluded[1]) <= excluded[4]
        and abs(column - excluded[2]) <= excluded[4]
    ):
        return
    is_earlier = best[1] >= 0 and (
        turn < best[1] or (turn == best[1] and (row < best[2] or (row == best[2] and column < best[3])))
    )
    if score > best[0] or (score == best[0] and is_earlier):
        best[0] = score
        best[1] = turn
        best[2] = row
        best[3] = column


@helper
def _push_children(
    stack: NDArray[np.int64],
    size: int,
    grid: NDArray[np.uint8],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    reach: int,
    weight: int,
    turn_cost: int,
) -> int:
    """Replace the node at ``size`` by its children, the greatest bound last; return the new size."""
    level, row, column = stack[size, 0], stack[size, 1], stack[size, 2]
    half = 1 << (level - 1)
    begin = size
    for part in range(4):
        child_row = row + half * (part // 2)
        child_column = column + half * (part % 2)
        if child_row > reach or child_column > reach:
            continue
        bound = _bound(grid, columns, rows, child_row, child_column, half, reach, weight) - turn_cost
        at = size
        while at > begin and stack[at - 1, 3] > bound:
            stack[at] = stack[at - 1]
            at -= 1
        stack[at, 0] = level - 1
        stack[at, 1] = child_row
        stack[at, 2] = child_column
        stack[at, 3] = bound
        size += 1
    return size


@kernel(
    "int64[::1](uint8[:, :, ::1], int32[:, ::1], int32[:, ::1], int64, int64[::1], int64, int64[::1], int64)",
    numpy=_search_numpy,
)
def search(
    levels: NDArray[np.uint8],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    reach: int,
    turn_costs: NDArray[np.int64],
    weight: int,
    excluded: NDArray[np.int64],
    floor: int,
) -> NDArray[np.int64]:
    """Return (score, turn, row shift, column shift) of the best pose, score -1 if all are below ``floor``.

    Of poses with the same score the one with the least turn, row and column is returned.

    Args:
        levels: The field's pyramid, shape (L, height, width).
        columns: Columns of the scan's points at each turn, shape (turns, N).
        rows: Their rows, shape (turns, N).
        reach: Greatest shift along each axis, cells, at least 1.
        turn_costs: What each turn costs, shape (turns,).
        weight: What the greatest shift along an axis costs, in parts of 1 / SCALE.
        excluded: Pose that is left out (turn, row, column) and how far around it (turns, cells); -1 for none.
        floor: Least score, at least 0.
    """
    top = 0
    while top + 1 < len(levels) and (1 << (top + 1)) <= reach:
        top += 1
    stride = 1 << top
    side = (2 * reach) // stride + 1
    bounds = np.empty(len(columns) * side * side, np.int64)
    for root in range(len(bounds)):
        turn = root // (side * side)
        row = (root // side) % side * stride - reach
        column = root % side * stride - reach
        bounds[root] = (
            _bound(levels[top], columns[turn], rows[turn], row, column, stride, reach, weight)
            - turn_costs[turn]
        )
    order = np.argsort(-bounds)
    best = np.array([floor - 1, -1, 0, 0], np.int64)
    # At most three nodes are left behind at each level on the way down.
    stack = np.empty((3 * top + 4, 4), np.int64)
    for root in order:
        if bounds[root] < max(best[0], floor):
            break
        turn = root // (side * side)
        stack[0, 0] = top
        stack[0, 1] = (root // side) % side * stride - reach
        stack[0, 2] = root % side * stride - reach
        stack[0, 3] = bounds[root]
        size = 1
        while size > 0:
            size -= 1
            level, row, column, bound = stack[size]
            if bound < max(best[0], floor):
                continue
            if level == 0:
                _take_leaf(best, excluded, bound, turn, row, column)
                continue
            size = _push_children(
                stack, size, levels[level - 1], columns[turn], rows[turn], reach, weight, turn_costs[turn]
            )
    if best[1] < 0:
        best[0] = -1
    return best
