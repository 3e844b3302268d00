"""Likelihood fields of points and their pyramids of maxima, for correlative matching.

A field is a grid of 0 to 255: 255 where a point is, falling as a Gaussian around it. Level h of its pyramid
holds at each cell the greatest value of the 2^h x 2^h cells from it upwards, so a sum over level h bounds
the sums over level 0 of all those shifts (Olson 2009, "Real-time correlative scan matching"; Hess et al.
2016, section V).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

PEAK = 255


@dataclass(frozen=True, slots=True, eq=False)
class FieldPyramid:
    """A likelihood field with its maxima.

    Attributes:
        levels: shape (L, rows, columns), uint8; row 0 is the lowest y.
        origin: Corner (x, y) of cell (0, 0), metres.
        cell: Size of a cell, metres.
    """

    levels: NDArray[np.uint8]
    origin: tuple[float, float]
    cell: float

    def cells(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the (column, row) of points, shape (..., 2); they may be outside the field."""
        cells: NDArray[np.int32] = np.floor((points - self.origin) / self.cell).astype(np.int32)
        return cells


def make_field(points: NDArray[np.float64], *, cell: float, spread: float, levels: int) -> FieldPyramid:
    """Return the field of points.

    Args:
        points: shape (N, 2), metres.
        cell: Size of a cell, metres.
        spread: Standard deviation of the Gaussian, metres.
        levels: Number of levels of the pyramid, at least 1.
    """
    reach = int(np.ceil(3 * spread / cell))
    margin = reach + (1 << (levels - 1))
    if len(points) == 0:
        return FieldPyramid(np.zeros((levels, 1, 1), np.uint8), (0.0, 0.0), cell)
    low = np.floor(points.min(0) / cell).astype(np.int64) - margin
    origin = (float(low[0] * cell), float(low[1] * cell))
    where = np.floor(points / cell).astype(np.int64) - low
    columns, rows = (where.max(0) + reach + 1).tolist()
    field = np.zeros((rows, columns), np.uint8)
    flat = np.unique(where[:, 1] * columns + where[:, 0])
    paint(field, flat // columns, flat % columns, _stamp(cell, spread, reach))
    pyramid = np.empty((levels, rows, columns), np.uint8)
    pyramid[0] = field
    for level in range(1, levels):
        _pool(pyramid[level - 1], 1 << (level - 1), pyramid[level])
    return FieldPyramid(pyramid, origin, cell)


def _stamp(cell: float, spread: float, reach: int) -> NDArray[np.uint8]:
    """Return the Gaussian around one point, shape (2 reach + 1, 2 reach + 1)."""
    offsets = np.arange(-reach, reach + 1) * cell
    values = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2) / spread**2)
    return np.round(PEAK * values).astype(np.uint8)


def _paint_numpy(
    field: NDArray[np.uint8], rows: NDArray[np.int64], columns: NDArray[np.int64], stamp: NDArray[np.uint8]
) -> None:
    reach = len(stamp) // 2
    flat = field.reshape(-1)
    cells = rows * field.shape[1] + columns
    for row in range(-reach, reach + 1):
        for column in range(-reach, reach + 1):
            at = cells + (row * field.shape[1] + column)
            flat[at] = np.maximum(flat[at], stamp[row + reach, column + reach])


@kernel("void(uint8[:, ::1], int64[::1], int64[::1], uint8[:, ::1])", numpy=_paint_numpy)
def paint(
    field: NDArray[np.uint8], rows: NDArray[np.int64], columns: NDArray[np.int64], stamp: NDArray[np.uint8]
) -> None:
    """Raise a field to a stamp around each cell; the stamps lie inside the field.

    Args:
        field: Changed in place, shape (height, width).
        rows: Rows of the cells, each cell once, shape (N,).
        columns: Their columns, shape (N,).
        stamp: Values around a cell, shape (2 r + 1, 2 r + 1).
    """
    size = len(stamp)
    reach = size // 2
    for point in range(len(rows)):
        top = rows[point] - reach
        left = columns[point] - reach
        for row in range(size):
            for column in range(size):
                field[top + row, left + column] = max(field[top + row, left + column], stamp[row, column])


def _pool(source: NDArray[np.uint8], step: int, target: NDArray[np.uint8]) -> None:
    across = source.copy()
    if source.shape[1] > step:
        np.maximum(source[:, :-step], source[:, step:], out=across[:, :-step])
    target[:] = across
    if source.shape[0] > step:
        np.maximum(across[:-step], across[step:], out=target[:-step])
