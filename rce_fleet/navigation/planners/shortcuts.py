"""Straightens ways of cells: replaces parts by straight lines that cost no more."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Steps = NDArray[np.int16]

_TOLERANCE = 1.0001
"""How much more a straight line may cost than the steps that it replaces: the rounding of diagonal steps."""


def line_cells(start: Floats, end: Floats) -> tuple[Ints, Ints, Floats]:
    """Return the cells that a straight line crosses, and the length inside each.

    Args:
        start: Row and column, shape (2,); whole numbers are the lower corners of cells.
        end: The same of the other end.

    Returns:
        Rows, columns and lengths (in cells), each of shape (K,), in order from the start.
    """
    delta = end - start
    cuts = [np.array((0.0, 1.0))]
    for axis in (0, 1):
        low, high = sorted((start[axis], end[axis]))
        lines = np.arange(np.floor(low) + 1, np.ceil(high))
        if len(lines):
            cuts.append((lines - start[axis]) / delta[axis])
    at = np.sort(np.concatenate(cuts))
    lengths = np.diff(at) * float(np.hypot(*delta))
    middle = (at[1:] + at[:-1]) / 2
    rows = np.floor(start[0] + middle * delta[0]).astype(np.int64)
    columns = np.floor(start[1] + middle * delta[1]).astype(np.int64)
    return rows, columns, lengths


def line_cost(steps: Steps, start: Floats, end: Floats) -> float:
    """Return the cost of a straight line; ``inf`` if it crosses a cell that cannot be entered.

    Through a corner of four cells it leads only where all of them can be entered, as a diagonal step.
    """
    rows, columns, lengths = line_cells(start, end)
    prices = steps[rows, columns]
    crossed = lengths > 1e-9  # noqa: PLR2004 - a line through a corner touches cells without crossing them
    if not prices[crossed].all():
        return np.inf
    rows, columns = rows[crossed], columns[crossed]
    corners = np.flatnonzero((np.diff(rows) != 0) & (np.diff(columns) != 0))
    beside = steps[rows[corners], columns[corners + 1]], steps[rows[corners + 1], columns[corners]]
    if not all(each.all() for each in beside):
        return np.inf
    return float(prices @ lengths)


def straighten(steps: Steps, cells: Ints) -> Ints:
    """Return which cells of a way remain as corners, shape (K, 2); the first and the last remain.

    Args:
        steps: Cost of a straight step from each cell; 0: it cannot be entered.
        cells: Rows and columns of the way, shape (N, 2).
    """
    points = cells + 0.5
    moves = np.hypot(*np.diff(cells, axis=0).T)
    prices = steps[cells[:, 0], cells[:, 1]]
    spent = np.concatenate(((0.0,), np.cumsum(moves * (prices[:-1] + prices[1:]) / 2)))
    last = len(cells) - 1
    corners = [0]
    here = 0

    def is_cheap(there: int) -> bool:
        budget = (spent[there] - spent[here]) * _TOLERANCE
        return line_cost(steps, points[here], points[there]) <= float(budget)

    while here < last:
        good, stride = here + 1, 2
        while here + stride <= last and is_cheap(here + stride):
            good, stride = here + stride, stride * 2
        bad = min(here + stride, last + 1)
        while bad - good > 1:
            middle = (good + bad) // 2
            if is_cheap(middle):
                good = middle
            else:
                bad = middle
        corners.append(good)
        here = good
    return cells[corners]
