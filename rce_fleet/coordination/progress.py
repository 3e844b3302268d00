"""A robot's progress on its granted cells, and its cell when it was stopped between cells."""

from __future__ import annotations

from itertools import pairwise
from math import hypot
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from rce_fleet.coordination.settings import FleetSettings
    from rce_fleet.planning.grid import GridMap


def arrived_index(
    grid: GridMap, cells: Sequence[int], x: float, y: float, settings: FleetSettings
) -> int | None:
    """Return the index of the last path cell in which a robot at ``(x, y)`` has fully arrived.

    It has arrived in a cell when it is near the centre, or between it and the next centre. ``None`` if
    it has not arrived in the first.
    """
    centres = [grid.centre(cell) for cell in cells]
    for index in range(len(cells) - 1, -1, -1):
        cx, cy = centres[index]
        if hypot(x - cx, y - cy) <= settings.arrival_tolerance:
            return index
    for index, ((ax, ay), (bx, by)) in reversed(list(enumerate(pairwise(centres)))):
        along = ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / grid.cell_size
        beside = abs((x - ax) * (by - ay) - (y - ay) * (bx - ax)) / grid.cell_size
        if 0.0 <= along <= grid.cell_size and beside <= settings.corridor:
            return index
    return None


def standing_cell(
    grid: GridMap, touched: Collection[int], x: float, y: float, shut: Collection[int]
) -> int | None:
    """Return the cell for a robot that stands at ``(x, y)`` and overlaps ``touched``.

    It is the nearest one that is not ``shut``; the nearest of all if all are.
    """
    open_cells = [cell for cell in touched if cell not in shut] or list(touched)

    def away(cell: int) -> float:
        cx, cy = grid.centre(cell)
        return hypot(x - cx, y - cy)

    return min(open_cells, key=away, default=None)
