"""Exact ranges in a map of cells: where a ray first enters an occupied cell.

Each ray steps from cell border to cell border (Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray
Tracing", 1987). Distances are computed from the number of the border, not added up, so they are exact to
rounding, and the numpy and the compiled form give the same bits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel
from rce_fleet.geometry.angles import wrap_array
from rce_fleet.geometry.poses import transform_points

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap


def cast_rays(
    grid: OccupancyMap, origins: ArrayLike, angles: ArrayLike, max_range: float
) -> NDArray[np.float64]:
    """Return how far rays go before they enter an occupied cell.

    Args:
        grid: The map. Unknown cells, and everything outside of the map, let rays pass.
        origins: shape (N, 2) or (2,): where the rays begin, in the world, metres. May be outside of the map.
        angles: shape (N,): directions in the world, radians.
        max_range: Rays end here, metres.

    Returns:
        shape (N,): metres; ``max_range`` where a ray enters no occupied cell, 0 where it begins in one.
    """
    directions = np.atleast_1d(np.asarray(angles, np.float64)) - grid.origin.yaw
    starts = np.broadcast_to(np.asarray(origins, np.float64), (len(directions), 2))
    local = np.ascontiguousarray(transform_points(grid.origin.inverse().as_array(), starts) / grid.resolution)
    cells = cast_in_cells(grid.occupied, local, wrap_array(directions), max_range / grid.resolution)
    return np.minimum(cells * grid.resolution, max_range)


def _cast_numpy(
    occupied: NDArray[np.bool_], starts: NDArray[np.float64], angles: NDArray[np.float64], limit: float
) -> NDArray[np.float64]:
    rows, columns = occupied.shape
    result = np.full(len(starts), limit)
    ray = np.arange(len(starts))
    x, y = starts[:, 0].copy(), starts[:, 1].copy()
    dx, dy = np.cos(angles), np.sin(angles)
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    step_x, step_y = np.where(dx > 0, 1, -1), np.where(dy > 0, 1, -1)
    distance = np.zeros(len(starts))
    while len(ray):
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        hit = inside.copy()
        hit[inside] = occupied[row[inside], column[inside]]
        result[ray[hit]] = distance[hit]
        with np.errstate(divide="ignore", invalid="ignore"):
            to_x = np.where(dx != 0, (column + (dx > 0) - x) / dx, np.inf)
            to_y = np.where(dy != 0, (row + (dy > 0) - y) / dy, np.inf)
        along_x = to_x < to_y
        distance = np.where(along_x, to_x, to_y)
        column = np.where(along_x, column + step_x, column)
        row = np.where(along_x, row, row + step_y)
        gone = (
            ((step_x > 0) & (column >= columns))
            | ((step_x < 0) & (column < 0))
            | ((step_y > 0) & (row >= rows))
            | ((step_y < 0) & (row < 0))
        )
        keep = ~hit & (distance < limit) & ~gone
        if not keep.all():
            ray, x, y, dx, dy = ray[keep], x[keep], y[keep], dx[keep], dy[keep]
            column, row, step_x, step_y = column[keep], row[keep], step_x[keep], step_y[keep]
            distance = distance[keep]
    return result


@kernel("float64[::1](boolean[:,::1], float64[:,::1], float64[::1], float64)", numpy=_cast_numpy)
def cast_in_cells(
    occupied: NDArray[np.bool_], starts: NDArray[np.float64], angles: NDArray[np.float64], limit: float
) -> NDArray[np.float64]:
    """Return lengths of rays in cells; the map's frame, one cell is 1 x 1.

    Args:
        occupied: shape (rows, columns).
        starts: shape (N, 2): x (columns), y (rows).
        angles: shape (N,), radians.
        limit: The longest ray.

    Returns:
        shape (N,).
    """
    rows, columns = occupied.shape
    result = np.empty(len(starts))
    for i in range(len(starts)):
        x, y = starts[i, 0], starts[i, 1]
        dx, dy = np.cos(angles[i]), np.sin(angles[i])
        column, row = int(np.floor(x)), int(np.floor(y))
        ahead_x, ahead_y = int(dx > 0), int(dy > 0)
        step_x, step_y = 2 * ahead_x - 1, 2 * ahead_y - 1
        distance = 0.0
        result[i] = limit
        while distance < limit:
            if 0 <= row < rows and 0 <= column < columns and occupied[row, column]:
                result[i] = distance
                break
            to_x = (column + ahead_x - x) / dx if dx != 0 else np.inf
            to_y = (row + ahead_y - y) / dy if dy != 0 else np.inf
            if to_x < to_y:
                distance = to_x
                column += step_x
                if column >= columns if step_x > 0 else column < 0:
                    break
            else:
                distance = to_y
                row += step_y
                if row >= rows if step_y > 0 else row < 0:
                    break
    return result
