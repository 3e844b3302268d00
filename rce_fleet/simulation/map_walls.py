"""Walls from an occupancy map and back: vectorised once when a scene is loaded, drawn for localization."""

from __future__ import annotations

from math import ceil, floor
from typing import TYPE_CHECKING

import numpy as np
from pymunk import BB
from pymunk.autogeometry import march_soft, simplify_curves

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose, transform_points
from rce_fleet.maps.occupancy_map import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, OccupancyMap
from rce_fleet.simulation.lidar import Floats
from rce_fleet.simulation.walls import Block, Point, Walls, distances

if TYPE_CHECKING:
    from collections.abc import Iterable


TILE = 32
"""Cells of a side of the squares that are vectorised one by one: those without a wall are left out."""
_DIGITS = 9
"""Digits of a map's origin: without the noise of binary fractions."""
TOLERANCE = 0.5
"""Cells that a simplified line may be away from the cells' edge."""


def walls_of_map(grid: OccupancyMap) -> Walls:
    """Return the outlines of a map's occupied cells as thin walls, in the world's frame.

    Marching squares give the outlines, and a line replaces the points that it passes within half a cell.
    Unknown cells are not walls.
    """
    solid = np.pad(grid.occupied, 1)  # So that outlines at the map's border are closed.
    found: list[Floats] = []
    rows, columns = solid.shape
    for row in range(0, rows - 1, TILE):
        for column in range(0, columns - 1, TILE):
            last_row, last_column = min(row + TILE, rows - 1), min(column + TILE, columns - 1)
            tile = solid[row : last_row + 1, column : last_column + 1]
            if tile.any() and not tile.all():
                found += _outlines(tile, row, column)
    if not found:
        return Walls()
    # Sample (row, column) is the middle of a cell; the padding added one cell at both sides.
    points = (np.concatenate(found).reshape(-1, 2) - 0.5) * grid.resolution
    return Walls(lines=transform_points(grid.origin.as_array(), points).reshape(-1, 4))


def _outlines(tile: np.ndarray, row: int, column: int) -> list[Floats]:
    """Return the outlines in a tile, arrays of shape (N, 4): column, row of both ends."""
    values = tile.astype(float).tolist()
    last_row, last_column = tile.shape[0] - 1, tile.shape[1] - 1

    def sample(point: tuple[float, float]) -> float:
        return float(values[round(point[1])][round(point[0])])

    box = BB(0.0, 0.0, float(last_column), float(last_row))
    lines = []
    for line in march_soft(box, last_column + 1, last_row + 1, 0.5, sample):
        simple = np.array(simplify_curves(line, TOLERANCE), np.float64) + np.array((column, row))
        if len(simple) > 1:
            lines.append(np.hstack((simple[:-1], simple[1:])))
    return lines


def draw_map(
    walls: Walls, inside: Iterable[Point], *, resolution: float = 0.05, margin: float = 0.3
) -> OccupancyMap:
    """Return the map of walls, as a perfect mapper would make it.

    Centres of cells lie at multiples of the resolution, so that walls on such places are drawn where sensors
    see them. What cannot be reached from ``inside`` is unknown.

    Args:
        walls: The walls; glass is drawn too.
        inside: Points of the free floor, such as the middles of cells.
        resolution: Edge of a cell, metres.
        margin: Unknown border around the walls, metres.

    Raises:
        MapError: The map would be too large.
    """
    left, low, right, high = walls.bounds
    first_column, first_row = floor((left - margin) / resolution), floor((low - margin) / resolution)
    columns = ceil((right + margin) / resolution) - first_column + 1
    rows = ceil((high + margin) / resolution) - first_row + 1
    if rows * columns > MAX_CELLS:
        raise MapError(
            f"the map of walls from ({left:g}, {low:g}) to ({right:g}, {high:g}) m would have"
            f" {columns} x {rows} cells of {resolution:g} m, more than {MAX_CELLS}; remove walls that are far"
            " away"
        )
    solid = np.zeros((rows, columns), np.bool_)
    reach = resolution / 2
    for block in walls.blocks:
        _draw(solid, np.array(block.edges), (first_column, first_row), resolution, 1e-9, block)
    for line in np.concatenate((walls.lines, walls.glass_lines)):
        _draw(solid, line[None], (first_column, first_row), resolution, reach)
    from scipy import ndimage  # long to load, needed only where a map is drawn

    free, _ = ndimage.label(~solid)
    places = np.array(list(inside), np.float64).reshape(-1, 2)
    cells = np.round(places / resolution).astype(int) - np.array((first_column, first_row))
    on_map = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
    rooms = np.unique(free[cells[on_map, 1], cells[on_map, 0]])
    data = np.where(np.isin(free, rooms[rooms > 0]), FREE, UNKNOWN)
    data[solid] = OCCUPIED
    left, low = ((first - 0.5) * resolution for first in (first_column, first_row))
    origin = Pose(round(left, _DIGITS), round(low, _DIGITS), 0.0)
    return OccupancyMap(data.astype(np.int8), resolution, origin)


def _draw(
    solid: np.ndarray,
    edges: Floats,
    first: tuple[int, int],
    resolution: float,
    reach: float,
    block: Block | None = None,
) -> None:
    """Mark the cells whose centres are within ``reach`` of the edges, or inside of the block."""
    ends = edges.reshape(-1, 2)
    low = np.maximum(np.floor((ends.min(axis=0) - reach) / resolution).astype(int) - first, 0)
    high = np.ceil((ends.max(axis=0) + reach) / resolution).astype(int) - first
    columns, rows = np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)
    x, y = np.meshgrid((columns + first[0]) * resolution, (rows + first[1]) * resolution)
    away = distances(np.stack((x.ravel(), y.ravel()), axis=1), edges, block)
    near = (away <= reach + 1e-9).reshape(len(rows), len(columns))
    part = solid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    part |= near[: part.shape[0], : part.shape[1]]
