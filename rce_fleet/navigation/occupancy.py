"""The map as an occupancy grid, in the layout of ``nav_msgs/OccupancyGrid``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap

FREE = 0
OCCUPIED = 100


@dataclass(frozen=True, slots=True)
class Occupancy:
    """The fields of ``nav_msgs/OccupancyGrid``.

    Attributes:
        resolution: Edge of a pixel, metres.
        width: Pixels along x.
        height: Pixels along y.
        origin: Outer corner of pixel (0, 0), ``(x, y)`` in metres.
        yaw: Direction of the rows of pixels, radians counter-clockwise from x.
        data: shape (height * width,), int8, row by row: 0 free, 100 occupied.
    """

    resolution: float
    width: int
    height: int
    origin: tuple[float, float]
    data: NDArray[np.int8]
    yaw: float = 0.0


def occupancy(grid: GridMap, blocked: Iterable[int] = (), *, pixels_per_cell: int = 1) -> Occupancy:
    """Return the occupancy grid of a map, with its own blocked cells and the given ones.

    With one pixel per cell the index in ``data`` is the cell number.
    """
    if pixels_per_cell < 1:
        raise ValueError(f"pixels_per_cell must be at least 1, not {pixels_per_cell}")
    cells = np.full(len(grid), FREE, np.int8)
    cells[sorted(grid.blocked.union(blocked))] = OCCUPIED
    picture = cells.reshape(grid.rows, grid.columns)
    picture = picture.repeat(pixels_per_cell, axis=0).repeat(pixels_per_cell, axis=1)
    return Occupancy(
        resolution=grid.cell_size / pixels_per_cell,
        width=picture.shape[1],
        height=picture.shape[0],
        origin=grid.origin,
        data=picture.reshape(-1),
        yaw=grid.yaw,
    )
