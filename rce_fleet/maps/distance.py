"""Distances to the nearest occupied cell."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

if TYPE_CHECKING:
    from rce_fleet.maps.occupancy_map import OccupancyMap


Squares = NDArray[np.unsignedinteger[Any]]
"""Squared distances in cells. Such a field takes a quarter of the memory of one in metres."""
_BAND = 1 << 18
"""Cells that are computed at a time: scipy needs 40 bytes for each."""


def squares_to_nearest(mask: NDArray[np.bool_], reach: int) -> Squares:
    """Return the square of each cell's distance to the nearest cell that is set, in cells.

    Args:
        mask: Shape (rows, columns).
        reach: Cells that are farther away than so many get ``reach**2 + 1``.

    Returns:
        Shape (rows, columns), uint16 if ``reach`` is below 256, else uint32.
    """
    far = reach * reach + 1
    rows, columns = mask.shape
    found: Squares = np.full(mask.shape, far, np.uint16 if far <= np.iinfo(np.uint16).max else np.uint32)
    height = max(4 * reach, _BAND // columns, 1)
    for low in range(0, rows, height):
        high = min(low + height, rows)
        first = max(low - reach, 0)
        around = mask[first : high + reach]  # what lies beyond is too far away to matter
        if around.any():
            away = ndimage.distance_transform_edt(~around)[low - first : high - first]
            np.minimum(np.rint(away * away), far, out=found[low:high], casting="unsafe")
    return found


def distance_field(grid: OccupancyMap, max_m: float = inf) -> NDArray[np.float64]:
    """Return each cell's distance to the nearest occupied cell.

    Args:
        grid: The map. Unknown cells count as free.
        max_m: Farther cells get this distance, metres.

    Returns:
        shape (rows, columns): metres between the centres of the cells; 0 in occupied ones. Without any
        occupied cell everything is ``max_m``.
    """
    return distances_to(grid.occupied, grid.resolution, max_m)


def distances_to(mask: NDArray[np.bool_], resolution: float, max_m: float = inf) -> NDArray[np.float64]:
    """Return each cell's distance to the nearest cell that is set in ``mask``, shape (rows, columns)."""
    if not mask.any():
        return np.full(mask.shape, max_m)
    cells = ndimage.distance_transform_edt(~mask)
    return np.asarray(np.minimum(cells * resolution, max_m), np.float64)
