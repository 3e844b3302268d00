"""A map of cells that are free, occupied or unknown, as ``nav_msgs/OccupancyGrid`` has it.

Row 0 is the lowest y and column 0 the lowest x in the map's own frame. This frame lies in the world at
``origin``: the outer corner of cell (0, 0), and the direction of the columns. Values are -1 (unknown) and
0 .. 100 (the probability of an obstacle, percent).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose, transform_points

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

UNKNOWN = -1
FREE = 0
OCCUPIED = 100
OCCUPIED_FROM = 65
"""Cells with this value or a higher one count as occupied (map_saver's ``--occ``)."""
FREE_UP_TO = 25
"""Cells with a value from 0 to this one count as free (map_saver's ``--free``)."""
ORIGIN = Pose(0.0, 0.0, 0.0)
MAX_CELLS = 400_000_000
"""Maximum size of a map, so that a wrong header does not fill the memory."""


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A grid of cells. Immutable; the array is read-only.

    Attributes:
        data: shape (rows, columns), int8: -1 unknown, 0 free .. 100 occupied.
        resolution: Edge of a cell, metres.
        origin: Outer corner of cell (0, 0), and the direction in which columns grow, in the world.
    """

    data: NDArray[np.int8]
    resolution: float = 0.05
    origin: Pose = ORIGIN

    def __post_init__(self) -> None:
        if self.data.ndim != 2 or self.data.size == 0:  # noqa: PLR2004  # rows and columns
            raise MapError(
                f"a map needs at least one row and one column; its data has shape {self.data.shape}"
            )
        if not (isfinite(self.resolution) and self.resolution > 0):
            raise MapError(f"the resolution must be a positive number of metres, not {self.resolution}")
        if not all(map(isfinite, (self.origin.x, self.origin.y, self.origin.yaw))):
            raise MapError(f"the origin must be three finite numbers, not {self.origin}")
        data = np.ascontiguousarray(self.data, np.int8)
        if data is self.data or data.base is not None:
            data = data.copy()
        data.flags.writeable = False
        object.__setattr__(self, "data", data)

    @classmethod
    def from_message(
        cls, width: int, height: int, data: ArrayLike, resolution: float, origin: Pose
    ) -> OccupancyMap:
        """Return the map of the fields of a ``nav_msgs/OccupancyGrid``.

        Args:
            width: Columns.
            height: Rows.
            data: shape (height * width,), row by row.
            resolution: Edge of a cell, metres.
            origin: Pose of the outer corner of cell (0, 0).

        Raises:
            MapError: Size, values or resolution are not those of a map.
        """
        values = np.asarray(data)
        if width < 1 or height < 1 or values.size != width * height:
            raise MapError(f"a map of {width} x {height} cells came with {values.size} values")
        if values.min() < UNKNOWN or values.max() > OCCUPIED:
            raise MapError(
                f"the values of a map must be within -1 .. 100, not {values.min()} .. {values.max()}"
            )
        return cls(values.astype(np.int8).reshape(height, width), resolution, origin)

    # Sizes and cells

    @property
    def rows(self) -> int:
        """Number of rows, along y of the map's frame."""
        return int(self.data.shape[0])

    @property
    def columns(self) -> int:
        """Number of columns, along x of the map's frame."""
        return int(self.data.shape[1])

    @property
    def size(self) -> tuple[float, float]:
        """Width (along columns) and height, metres."""
        return self.columns * self.resolution, self.rows * self.resolution

    @cached_property
    def occupied(self) -> NDArray[np.bool_]:
        """Which cells are occupied (at least 65), shape (rows, columns)."""
        return np.asarray(self.data >= OCCUPIED_FROM)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which cells are free (0 .. 25), shape (rows, columns)."""
        return np.asarray((self.data >= FREE) & (self.data <= FREE_UP_TO))

    @cached_property
    def free_count(self) -> int:
        """Number of free cells."""
        return int(self._free_until[-1])

    def free_cells(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return free cells by their numbers, row by row, without a list of all: that takes 16 bytes a cell.

        Args:
            numbers: shape (N,), from 0 to below ``free_count``.

        Returns:
            shape (N, 2): row, column.
        """
        rows = np.searchsorted(self._free_until, numbers, side="right")
        in_row = numbers - np.concatenate(((0,), self._free_until))[rows]
        columns = np.empty(len(numbers), np.int64)
        order = np.argsort(rows, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(rows[order])) + 1):
            if len(part):
                columns[part] = np.flatnonzero(self.free[rows[part[0]]])[in_row[part]]
        return np.stack((rows, columns), axis=1)

    @cached_property
    def _free_until(self) -> NDArray[np.int64]:
        """Number of free cells up to each row, with it; shape (rows,)."""
        return np.cumsum(np.count_nonzero(self.free, axis=1))

    @cached_property
    def unknown(self) -> NDArray[np.bool_]:
        """Which cells are neither free nor occupied, shape (rows, columns)."""
        return ~(self.occupied | self.free)

    # Places

    def world_to_cell(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return ``(row, column)`` of points in the world; cells outside of the map have such numbers too.

        Args:
            points: shape (..., 2): x, y in metres. Must be finite.

        Returns:
            shape (..., 2), int64.
        """
        local = transform_points(self._to_map, points)
        return np.floor(local[..., ::-1] / self.resolution).astype(np.int64)

    def cell_to_world(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the centres of cells in the world.

        Args:
            cells: shape (..., 2): row, column.

        Returns:
            shape (..., 2): x, y in metres.
        """
        centres = (np.asarray(cells, np.float64)[..., ::-1] + 0.5) * self.resolution
        return transform_points(self.origin.as_array(), centres)

    def inside(self, cells: ArrayLike) -> NDArray[np.bool_]:
        """Return which cells, shape (..., 2): row, column, are on the map."""
        places = np.asarray(cells)
        rows, columns = places[..., 0], places[..., 1]
        return np.asarray((rows >= 0) & (rows < self.rows) & (columns >= 0) & (columns < self.columns))

    def values_at(self, points: ArrayLike) -> NDArray[np.int8]:
        """Return the values at points in the world, shape (..., 2); outside of the map they are -1."""
        cells = self.world_to_cell(points)
        inside = self.inside(cells)
        safe = np.where(inside[..., None], cells, 0)
        return np.where(inside, self.data[safe[..., 0], safe[..., 1]], np.int8(UNKNOWN))

    @cached_property
    def _to_map(self) -> NDArray[np.float64]:
        return self.origin.inverse().as_array()
