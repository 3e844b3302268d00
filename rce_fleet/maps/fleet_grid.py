"""A fleet's grid of cells, laid over an occupancy map (``map.yaml``, from ``map_saver`` or ``rce map``)."""

from __future__ import annotations

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
    into which it cuts the free area counts as free. One that lies between two cells blocks the one that has
    more of it.

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
    look = _Look(drawn, place, cell_size, columns, blocked_share)
    blocked = np.flatnonzero(look.shut(rows))
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


class _Look:
    """Looks at the cells of a grid at evenly spaced points.

    Args:
        drawn: The map.
        place: Outer corner of cell 0 and direction of the columns.
        cell_size: Edge of a cell, metres.
        columns: Cells in a row.
        blocked_share: Share of a cell that may be taken or cut off.
    """

    def __init__(
        self, drawn: OccupancyMap, place: Pose, cell_size: float, columns: int, blocked_share: float
    ) -> None:
        self._drawn = drawn
        self._place = place.as_array()
        self._cell_size = cell_size
        self._columns = columns
        self._share = blocked_share
        self._free = drawn.free
        self._apart = _apart(self._free)
        # At most a pixel apart, so that no line of pixels lies between two of them.
        self._points = min(max(ceil(cell_size / drawn.resolution - 1e-6), 1), _MOST_POINTS)

    def shut(self, rows: int) -> NDArray[np.bool_]:
        """Return which cells are blocked, shape (rows * columns,)."""
        shares = np.zeros((rows, self._columns))
        below: NDArray[np.bool_] | None = None
        divided: list[tuple[int, int]] = []
        """Neighbours with a wall between them, as numbers of cells."""
        for row in range(rows):
            shares[row], parts = self._look_at(row)
            first = row * self._columns
            along = self._divided(shares[row, :-1], shares[row, 1:], parts[:-1], parts[1:], axis=2)
            divided += [(first + cell, first + cell + 1) for cell in along]
            if below is not None:
                up = self._divided(shares[row - 1], shares[row], below, parts, axis=1)
                divided += [(first - self._columns + cell, first + cell) for cell in up]
            below = parts
        taken = shares.reshape(-1)
        shut = taken > self._share
        for one, other in divided:
            if not (shut[one] or shut[other]):
                shut[one if taken[one] > taken[other] else other] = True
        return shut

    def _look_at(self, row: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Look at a row of cells.

        Returns:
            The shares of the cells that are not free, or cut off, shape (columns,); and which of their points
            are free and not connected over corners, shape (columns, points, points).
        """
        points, columns = self._points, self._columns
        inside = (np.arange(points) + 0.5) / points
        along = (np.arange(columns)[:, None] + inside).reshape(-1) * self._cell_size
        up = (row + inside) * self._cell_size
        grid = np.stack(np.broadcast_arrays(along[None, :], up[:, None]), axis=-1)
        cells = self._drawn.world_to_cell(transform_points(self._place, grid))
        on_map = self._drawn.inside(cells)
        safe = np.where(on_map[..., None], cells, 0)
        at = safe[..., 0], safe[..., 1]
        shape = points, columns, points
        shares = 1.0 - (on_map & self._free[at]).reshape(shape).mean(axis=(0, 2))
        parts = (on_map & self._apart[at]).reshape(shape).swapaxes(0, 1)
        unsure = np.flatnonzero((shares > 0) & (shares <= self._share))
        if len(unsure):
            shares[unsure] = np.maximum(shares[unsure], _cut_off(parts[unsure]))
        return shares, parts

    def _divided(
        self,
        shares: NDArray[np.float64],
        others: NDArray[np.float64],
        parts: NDArray[np.bool_],
        beside: NDArray[np.bool_],
        *,
        axis: int,
    ) -> list[int]:
        """Return which cells have a wall between them and the next one.

        Args:
            shares: Shares of cells that are not free, shape (N,).
            others: The same of the next cells.
            parts: Free points of the cells, shape (N, points, points).
            beside: The same of the next cells.
            axis: Along which axis of the points the next cells follow.
        """
        free = (shares <= self._share) & (others <= self._share)
        pairs = np.flatnonzero(free & ((shares > 0) | (others > 0)))
        if not len(pairs):
            return []
        joined = _are_joined(parts[pairs], beside[pairs], axis, 1.0 - self._share)
        return [int(pair) for pair in pairs[~joined]]


def _label(free: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Return the connected parts of each cell's free points.

    Args:
        free: Free points of each cell, shape (cells, rows, columns).

    Returns:
        Numbers of the parts, from 1, of the shape of ``free``; and the cell of each part, shape (parts + 1,).
    """
    from scipy.ndimage import label  # long to load, needed only where something stands in cells

    within = np.zeros((3, 3, 3), np.bool_)
    within[1] = ((False, True, False), (True, True, True), (False, True, False))
    labels, count = label(free, within)
    cell_of = np.zeros(count + 1, np.intp)
    cell_of[labels] = np.arange(len(free))[:, None, None]
    return labels, cell_of


def _cut_off(free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return which share of each cell is not in its largest connected part; 0 for a cell in one part.

    Args:
        free: Free points of each cell, shape (cells, rows, columns).
    """
    labels, cell_of = _label(free)
    sizes = np.bincount(labels.reshape(-1), minlength=len(cell_of))
    largest, parts = np.zeros(len(free)), np.zeros(len(free))
    np.maximum.at(largest, cell_of[1:], sizes[1:])
    np.add.at(parts, cell_of[1:], 1)
    area = free.shape[1] * free.shape[2]
    return np.where(parts > 1, 1.0 - largest / area, 0.0)


def _are_joined(
    free: NDArray[np.bool_], beside: NDArray[np.bool_], axis: int, share: float
) -> NDArray[np.bool_]:
    """Return whether a way leads from each cell to the one beside it that stays within both.

    It must lead from the largest free part of each, or from one that is ``share`` of the cell.

    Args:
        free: Free points of each cell, shape (cells, rows, columns).
        beside: The same of the cells beside.
        axis: Along which axis they lie beside each other, 1 or 2.
        share: As above.
    """
    labels, cell_of = _label(np.concatenate((free, beside), axis))
    is_enough = np.ones(len(cell_of), np.bool_)
    for half in np.split(labels, 2, axis):
        sizes = np.bincount(half.reshape(-1), minlength=len(cell_of))
        largest = np.zeros(len(free))
        np.maximum.at(largest, cell_of[1:], sizes[1:])
        area = free.shape[1] * free.shape[2]
        is_enough &= sizes >= np.minimum(largest, share * area)[cell_of]
    joined = np.zeros(len(free), np.bool_)
    joined[cell_of[1:][is_enough[1:]]] = True
    return joined
