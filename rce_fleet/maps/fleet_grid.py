"""A fleet's grid of cells, laid over an occupancy map (``map.yaml``, from ``map_saver`` or ``rce map``)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, isfinite, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose, transform_points
from rce_fleet.maps.occupancy_map import OCCUPIED, OccupancyMap
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_CELLS = 4_000_000
"""Maximum number of cells, so that a wrong cell size does not fill the memory."""
BLOCKED_SHARE = 0.1
"""A cell is blocked if a greater share of its area is occupied or unknown, or cut off by what is."""
LEAST_CELL_SIZE, MOST_CELL_SIZE = 0.001, 1000.0
"""Smallest and largest edge of a cell, metres."""
_FAR = 1e9
"""Metres or radians."""
_MOST_POINTS = 400
"""Points along an edge of a cell that are looked at: a large cell does not fill the memory."""
_FINE = 0.05
"""Edge of a pixel of a grid's map, metres, so that other cells can be laid over it."""
_PIXELS = 4_000_000
"""Pixels of such a map: a large grid gets larger ones."""


def fleet_grid(
    drawn: OccupancyMap,
    cell_size: float = 1.0,
    *,
    origin: Pose | None = None,
    rows: int | None = None,
    columns: int | None = None,
    blocked_share: float = BLOCKED_SHARE,
    max_cells: int = MAX_CELLS,
) -> GridMap:
    """Return the grid of cells over a map.

    A wall that is thinner than ``blocked_share`` blocks a cell that it cuts: only the largest of the parts
    into which it cuts the free area counts as free.

    Args:
        drawn: The map.
        cell_size: Edge of a cell, metres.
        origin: Outer corner of cell 0 and direction of the columns, in the world; by default those of the
            map.
        rows: Number of rows; by default as many as the map needs above the origin.
        columns: Number of columns, likewise.
        blocked_share: A cell is blocked if more than this share of it is occupied, unknown, outside of the
            map or cut off by such places, 0 .. 1.
        max_cells: Maximum number of cells.

    Raises:
        MapError: The grid would have no free cell, or more than ``max_cells``; or a number is out of range.
    """
    if not (cell_size > 0 and isfinite(cell_size)):
        raise MapError(f"the cell size must be a positive number of metres, not {cell_size}")
    if not LEAST_CELL_SIZE <= cell_size <= MOST_CELL_SIZE:
        raise MapError(
            f"the cell size must be within {LEAST_CELL_SIZE} .. {MOST_CELL_SIZE:g} m, not {cell_size}"
        )
    if not 0 <= blocked_share <= 1:
        raise MapError(f"the share that blocks a cell must be within 0 .. 1, not {blocked_share}")
    place = drawn.origin if origin is None else origin
    if not all(map(isfinite, (place.x, place.y, place.yaw))):
        raise MapError(f"the origin must be three finite numbers, not {place}")
    if max(map(abs, (place.x, place.y, place.yaw))) > _FAR:
        raise MapError(f"the origin's numbers must be within -{_FAR:g} .. {_FAR:g}, not {place}")
    needed_rows, needed_columns = _size(drawn, place, cell_size)
    rows = needed_rows if rows is None else rows
    columns = needed_columns if columns is None else columns
    if not 0 < rows * columns <= max_cells or rows < 0:
        raise MapError(
            f"a grid of {columns} x {rows} cells is not within 1 .. {max_cells} cells; check cell size and"
            " origin"
        )
    free = drawn.free
    look = _Look(drawn, place, cell_size, columns, free, _apart(free))
    shares = np.concatenate([look.taken(row, blocked_share) for row in range(rows)])
    blocked = np.flatnonzero(shares > blocked_share)
    if len(blocked) == rows * columns:
        raise MapError(
            f"all {rows * columns} cells of {cell_size} m are blocked; check the origin, choose smaller"
            f" cells, or let more than {blocked_share:.0%} of a cell be occupied"
        )
    return GridMap(rows, columns, cell_size, (place.x, place.y), frozenset(map(int, blocked)), yaw=place.yaw)


def map_of_grid(grid: GridMap) -> OccupancyMap:
    """Return a map whose occupied places are the blocked cells of a grid."""
    fine = min(ceil(grid.cell_size / _FINE), floor(sqrt(_PIXELS / len(grid))))
    cells = np.zeros(len(grid), np.int8)
    cells[sorted(grid.blocked)] = OCCUPIED
    pixels = cells.reshape(grid.rows, grid.columns)
    for axis in (0, 1):
        pixels = np.repeat(pixels, max(fine, 1), axis)
    return OccupancyMap(pixels, grid.cell_size / max(fine, 1), Pose(*grid.origin, grid.yaw))


def _size(drawn: OccupancyMap, place: Pose, cell_size: float) -> tuple[int, int]:
    """Return rows and columns that reach the farthest corner of the map."""
    width, height = drawn.size
    corners = transform_points(
        drawn.origin.as_array(), [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)]
    )
    far = transform_points(place.inverse().as_array(), corners).max(axis=0) / cell_size
    columns, rows = (max(ceil(value - 1e-6), 0) for value in far)
    return rows, columns


def _apart(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the free pixels without one of each pair that touch at a corner between two others.

    What remains is connected over edges only, also where a turned grid looks at it.
    """
    apart = free.copy()
    low, high = free[:-1], free[1:]
    apart[:-1, :-1] &= ~(low[:, :-1] & high[:, 1:] & ~low[:, 1:] & ~high[:, :-1])
    apart[:-1, 1:] &= ~(low[:, 1:] & high[:, :-1] & ~low[:, :-1] & ~high[:, 1:])
    return apart


@dataclass(frozen=True, slots=True)
class _Look:
    """Looks at the cells of a grid at evenly spaced points.

    Attributes:
        drawn: The map.
        place: Outer corner of cell 0 and direction of the columns.
        cell_size: Edge of a cell, metres.
        columns: Cells in a row.
        free: Free pixels of the map.
        apart: The same, as of :func:`_apart`.
    """

    drawn: OccupancyMap
    place: Pose
    cell_size: float
    columns: int
    free: NDArray[np.bool_]
    apart: NDArray[np.bool_]

    def taken(self, row: int, blocked_share: float) -> NDArray[np.float64]:
        """Return the shares of a row's cells that are not free, or cut off, shape (columns,)."""
        # At most a pixel apart, so that no line of pixels lies between two of them.
        points = min(max(ceil(self.cell_size / self.drawn.resolution - 1e-6), 1), _MOST_POINTS)
        inside = (np.arange(points) + 0.5) / points
        along = (np.arange(self.columns)[:, None] + inside).reshape(-1) * self.cell_size
        up = (row + inside) * self.cell_size
        grid = np.stack(np.broadcast_arrays(along[None, :], up[:, None]), axis=-1)
        cells = self.drawn.world_to_cell(transform_points(self.place.as_array(), grid))
        on_map = self.drawn.inside(cells)
        safe = np.where(on_map[..., None], cells, 0)
        at = safe[..., 0], safe[..., 1]
        shape = points, self.columns, points
        shares = 1.0 - (on_map & self.free[at]).reshape(shape).mean(axis=(0, 2))
        unsure = np.flatnonzero((shares > 0) & (shares <= blocked_share))
        if len(unsure):
            parts = (on_map & self.apart[at]).reshape(shape)[:, unsure].swapaxes(0, 1)
            shares[unsure] = np.maximum(shares[unsure], _cut_off(parts))
        return np.asarray(shares, np.float64)


def _cut_off(free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return which share of each cell is not in its largest connected part; 0 for a cell in one part.

    Args:
        free: Free points of each cell, shape (cells, rows, columns).
    """
    from scipy.ndimage import label  # long to load, needed only where something stands in cells

    within = np.zeros((3, 3, 3), np.bool_)
    within[1] = ((False, True, False), (True, True, True), (False, True, False))
    labels, count = label(free, within)
    sizes = np.bincount(labels.reshape(-1), minlength=count + 1)
    cell_of = np.zeros(count + 1, np.intp)
    cell_of[labels] = np.arange(len(free))[:, None, None]
    largest, parts = np.zeros(len(free)), np.zeros(len(free))
    np.maximum.at(largest, cell_of[1:], sizes[1:])
    np.add.at(parts, cell_of[1:], 1)
    area = free.shape[1] * free.shape[2]
    return np.where(parts > 1, 1.0 - largest / area, 0.0)
