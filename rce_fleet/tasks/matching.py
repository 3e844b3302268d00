"""Pairs of rows and columns with the smallest sum of costs, some pairs forbidden.

With compiled loops (:mod:`rce_fleet.compiled`) they are found several times faster where a thousand robots
wait for a thousand tasks; the sum is the same without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.tasks.matching_loops import match_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

MATCHING_KERNELS = (match_rows,)


def cheapest_pairs(costs: NDArray[np.float64]) -> tuple[Ints, Ints]:
    """Return as many pairs as possible, and of all such choices one with the smallest sum of costs.

    Args:
        costs: What each pair costs, shape (rows, columns); ``inf``: the pair is forbidden.

    Returns:
        Rows, ascending, and the column of each; shape (pairs,) both. Of several choices with the same sum,
        compiled loops can return another one than scipy.

    Raises:
        ValueError: A cost is not a number, or ``-inf``.
    """
    may = np.isfinite(costs)
    rows, columns = np.flatnonzero(may.any(axis=1)), np.flatnonzero(may.any(axis=0))
    if not may.all():
        if np.isnan(costs).any() or np.isneginf(costs).any():
            raise ValueError("a cost must be a number or inf, not nan or -inf")
        if len(rows) < len(costs) or len(columns) < costs.shape[1]:
            part = np.ix_(rows, columns)
            costs, may = costs[part], may[part]
    if not len(rows):
        return rows, columns
    if not may.all():
        costs = np.where(may, costs, _forbidding(costs[may], min(costs.shape)))
    is_wide = len(rows) <= len(columns)
    found = match_rows(np.ascontiguousarray(costs if is_wide else costs.T))
    firsts, seconds = np.arange(len(found)), found
    if not is_wide:
        order = np.argsort(found)
        firsts, seconds = found[order], firsts[order]
    allowed = may[firsts, seconds]
    return rows[firsts[allowed]], columns[seconds[allowed]]


def _forbidding(costs: NDArray[np.float64], pairs: int) -> float:
    """Return a cost so large that no allowed pair is given up to save other costs.

    It is not larger than needed, so that sums with it keep as many digits as possible.
    """
    least, greatest = float(costs.min()), float(costs.max())
    return greatest + (greatest - least + 1.0) * pairs
