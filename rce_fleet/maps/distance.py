"""Distances to the nearest occupied cell."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap


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
