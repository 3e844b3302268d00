"""A grid of costs in a plane, and rectangles of its cells."""

from __future__ import annotations

from math import floor
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Cells = NDArray[np.intp]


T = TypeVar("T", bound=np.generic)


class Area(NamedTuple):
    """A rectangle of cells: rows ``low`` to ``high``, columns ``left`` to ``right``, both ends exclusive."""

    low: int
    left: int
    high: int
    right: int

    @property
    def is_empty(self) -> bool:
        """Whether it has no cell."""
        return self.high <= self.low or self.right <= self.left

    @property
    def slices(self) -> tuple[slice, slice]:
        """The index of the area in an array of shape (rows, columns, ...)."""
        return slice(self.low, self.high), slice(self.left, self.right)

    def grown(self, cells: int) -> Area:
        """Return the area with a border of ``cells`` cells; an empty area stays empty."""
        if self.is_empty:
            return self
        return Area(self.low - cells, self.left - cells, self.high + cells, self.right + cells)

    def joined(self, other: Area) -> Area:
        """Return the smallest area that contains both."""
        if self.is_empty or other.is_empty:
            return other if self.is_empty else self
        return Area(
            min(self.low, other.low),
            min(self.left, other.left),
            max(self.high, other.high),
            max(self.right, other.right),
        )

    def clipped(self, rows: int, columns: int) -> Area:
        """Return the part inside a grid of that size; nowhere if it is outside."""
        low, left = max(self.low, 0), max(self.left, 0)
        # An index below 0 counts from the end: an area below the grid must not end there.
        return Area(low, left, max(min(self.high, rows), 0), max(min(self.right, columns), 0))


NOWHERE = Area(0, 0, 0, 0)
FARTHEST = 2.0**31
"""The farthest row and column of a point."""


class CostGrid:
    """Costs of cells in rows along y and columns along x, parallel to the axes of its frame.

    Args:
        rows: Number of rows.
        columns: Number of columns.
        resolution: Edge of a cell, metres.
        origin: Outer corner of cell (0, 0), ``(x, y)`` in metres.
        fill: Cost of new cells.

    Attributes:
        values: Shape (rows, columns), uint8; row 0 has the lowest y.
        origin: As above; a rolling grid moves it.

    Raises:
        ValueError: The size or the resolution is not positive.
    """

    def __init__(
        self,
        rows: int,
        columns: int,
        resolution: float,
        origin: tuple[float, float] = (0.0, 0.0),
        *,
        fill: int = 0,
    ) -> None:
        if rows < 1 or columns < 1 or not resolution > 0:
            raise ValueError(
                "a costmap needs rows, columns and a resolution above 0,"
                f" not {rows} x {columns} cells of {resolution} m"
            )
        self.resolution = resolution
        self.origin = origin
        self.values = np.full((rows, columns), fill, np.uint8)
        self.fill = fill

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.values.shape[0], self.values.shape[1]

    @property
    def whole(self) -> Area:
        """The area of all cells."""
        return Area(0, 0, *self.shape)

    def cell_of(self, x: float, y: float) -> tuple[int, int]:
        """Return row and column of a point in metres; they may lie outside the grid.

        Points farther away than ``FARTHEST`` cells are in the farthest ones.
        """
        row, column = (y - self.origin[1]) / self.resolution, (x - self.origin[0]) / self.resolution
        return floor(min(max(row, -FARTHEST), FARTHEST)), floor(min(max(column, -FARTHEST), FARTHEST))

    def cells_of(self, points: Floats) -> Cells:
        """Return rows and columns of points, shape (N, 2); they may lie outside the grid.

        Args:
            points: Shape (N, 2), x and y in metres.
        """
        return np.floor((points[:, ::-1] - self.origin[::-1]) / self.resolution).astype(np.intp)

    def centres_of(self, cells: Cells) -> Floats:
        """Return the centres of cells in metres, shape (N, 2), from rows and columns, shape (N, 2)."""
        return self.corners_of(cells + 0.5)

    def corners_of(self, cells: NDArray[np.number[Any]]) -> Floats:
        """Return the lower left corners of cells in metres, shape (N, 2), from rows and columns, likewise."""
        return np.asarray(cells[:, ::-1] * self.resolution + np.asarray(self.origin), np.float64)

    def contains(self, cells: Cells) -> NDArray[np.bool_]:
        """Return which of the cells, shape (N, 2), are inside the grid."""
        rows, columns = self.shape
        row, column = cells[:, 0], cells[:, 1]
        return (row >= 0) & (row < rows) & (column >= 0) & (column < columns)

    def has(self, x: float, y: float) -> bool:
        """Return whether a point in metres is inside the grid."""
        row, column = self.cell_of(x, y)
        return 0 <= row < self.shape[0] and 0 <= column < self.shape[1]

    def cost_at(self, x: float, y: float, outside: int = 255) -> int:
        """Return the cost at a point in metres; ``outside`` where the grid ends."""
        row, column = self.cell_of(x, y)
        rows, columns = self.shape
        return int(self.values[row, column]) if 0 <= row < rows and 0 <= column < columns else outside

    def costs_at(self, points: Floats, outside: int = 255) -> NDArray[np.uint8]:
        """Return the costs at points, shape (N, 2) in metres; ``outside`` where the grid ends."""
        cells = self.cells_of(points)
        inside = self.contains(cells)
        costs = np.full(len(cells), outside, np.uint8)
        costs[inside] = self.values[cells[inside, 0], cells[inside, 1]]
        return costs

    def area_around(self, x: float, y: float, reach: float) -> Area:
        """Return the cells within a square of half edge ``reach`` around a point, inside the grid."""
        low, left = self.cell_of(x - reach, y - reach)
        high, right = self.cell_of(x + reach, y + reach)
        return Area(low, left, high + 1, right + 1).clipped(*self.shape)


def shift_of(
    origin: tuple[float, float], centre: tuple[float, float], shape: tuple[int, int], resolution: float
) -> tuple[int, int]:
    """Return by how many rows and columns a rolling window moves to have ``centre`` in its middle."""
    rows = int(np.floor((centre[1] - shape[0] * resolution / 2 - origin[1]) / resolution + 0.5))
    columns = int(np.floor((centre[0] - shape[1] * resolution / 2 - origin[0]) / resolution + 0.5))
    return rows, columns


def shifted(values: NDArray[T], rows: int, columns: int, fill: float) -> NDArray[T]:
    """Return an array, shape (rows, columns, ...), whose window moved by whole cells.

    Cells that came into the window get ``fill``.
    """
    moved = np.full_like(values, fill)
    height, width = values.shape[:2]
    if abs(rows) < height and abs(columns) < width:
        target = Area(max(-rows, 0), max(-columns, 0), height - max(rows, 0), width - max(columns, 0))
        source = Area(max(rows, 0), max(columns, 0), height - max(-rows, 0), width - max(-columns, 0))
        moved[target.slices] = values[source.slices]
    return moved
