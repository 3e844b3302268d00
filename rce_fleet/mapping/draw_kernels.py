"""Draws scans into maps of tiles: rays, hits, the nearest occupied cells, and the directions of walls.

Counting is GMapping's: each beam visits the cells on its way (Bresenham's line), and hits that at its end.
"""

from __future__ import annotations

from math import atan2, cos, floor, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.mapping.draw_numpy import register_numpy
from rce_fleet.mapping.tile_copies import own_tile
from rce_fleet.mapping.tiles import (
    LINE_POINTS,
    LINE_RATIO,
    MASK,
    NORMAL_REACH,
    RANKS,
    REACH,
    SELF,
    SHIFT,
    SPAN,
    VISITS_PER_HIT,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


@helper
def _add(
    table: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    column: int,
    row: int,
) -> None:
    """Tell the cells around a cell that it is occupied."""
    for y in range(row - REACH, row + REACH + 1):
        tile_column = -1
        tile = -1
        for x in range(column - REACH, column + REACH + 1):
            code = 1 + (row - y + REACH) * SPAN + column - x + REACH
            if (x - column) ** 2 + (y - row) ** 2 > REACH * REACH:
                continue
            if x >> SHIFT != tile_column:
                tile_column = x >> SHIFT
                tile = own_tile(
                    table, counts, points, owner, references, free, state, y >> SHIFT, tile_column
                )
            place = ((y & MASK) << SHIFT) | (x & MASK)
            if RANKS[code] < RANKS[owner[tile, place]]:
                owner[tile, place] = code


@helper
def _occupied_near(
    table: NDArray[np.int32], owner: NDArray[np.uint8], column: int, row: int, near: NDArray[np.int64]
) -> int:
    """List the occupied cells within twice the reach of a cell, without itself; return their number."""
    found = 0
    for y in range(row - 2 * REACH, row + 2 * REACH + 1):
        for x in range(column - 2 * REACH, column + 2 * REACH + 1):
            tile = table[y >> SHIFT, x >> SHIFT]
            if tile < 0 or (x == column and y == row):
                continue
            if owner[tile, ((y & MASK) << SHIFT) | (x & MASK)] == SELF:
                near[found, 0] = x
                near[found, 1] = y
                found += 1
    return found


@helper
def _nearest_code(near: NDArray[np.int64], found: int, x: int, y: int) -> int:
    """Return the code of the nearest of some cells within reach of a cell; 0 for none."""
    best = 0
    for i in range(found):
        dx = near[i, 0] - x
        dy = near[i, 1] - y
        if dx * dx + dy * dy <= REACH * REACH:
            other = 1 + (dy + REACH) * SPAN + dx + REACH
            if RANKS[other] < RANKS[best]:
                best = other
    return best


@helper
def _remove(
    table: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    column: int,
    row: int,
) -> None:
    """Give the cells around a cell that is no longer occupied to the next nearest one."""
    near = np.empty(((2 * SPAN) ** 2, 2), np.int64)
    found = _occupied_near(table, owner, column, row, near)
    for y in range(row - REACH, row + REACH + 1):
        for x in range(column - REACH, column + REACH + 1):
            if (x - column) ** 2 + (y - row) ** 2 > REACH * REACH:
                continue
            code = 1 + (row - y + REACH) * SPAN + column - x + REACH
            tile = own_tile(table, counts, points, owner, references, free, state, y >> SHIFT, x >> SHIFT)
            place = ((y & MASK) << SHIFT) | (x & MASK)
            if owner[tile, place] != code:
                continue
            owner[tile, place] = _nearest_code(near, found, x, y)


@helper
def _set_normal(
    table: NDArray[np.int32], points: NDArray[np.float32], owner: NDArray[np.uint8], column: int, row: int
) -> None:
    """Take the direction of the wall from the points around a cell."""
    number = 0
    mx = my = sxx = syy = sxy = 0.0
    for dy in range(-NORMAL_REACH, NORMAL_REACH + 1):
        for dx in range(-NORMAL_REACH, NORMAL_REACH + 1):
            x, y = column + dx, row + dy
            tile = table[y >> SHIFT, x >> SHIFT]
            place = ((y & MASK) << SHIFT) | (x & MASK)
            if tile < 0 or owner[tile, place] != SELF:
                continue
            px = points[tile, place, 0] + dx
            py = points[tile, place, 1] + dy
            number += 1
            mx += px
            my += py
            sxx += px * px
            syy += py * py
            sxy += px * py
    tile = table[row >> SHIFT, column >> SHIFT]
    place = ((row & MASK) << SHIFT) | (column & MASK)
    points[tile, place, 2] = 0.0
    points[tile, place, 3] = 0.0
    if number < LINE_POINTS:
        return
    mx /= number
    my /= number
    sxx = sxx / number - mx * mx
    syy = syy / number - my * my
    sxy = sxy / number - mx * my
    root = sqrt((sxx - syy) ** 2 / 4 + sxy * sxy)
    if (sxx + syy) / 2 - root <= LINE_RATIO * ((sxx + syy) / 2 + root):
        angle = 0.5 * atan2(2 * sxy, sxx - syy)
        points[tile, place, 2] = -sin(angle)
        points[tile, place, 3] = cos(angle)


@helper
def _trace(
    table: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    laser: NDArray[np.float64],
    ends: NDArray[np.float64],
    hit: NDArray[np.uint8],
    touched: NDArray[np.int64],
) -> int:
    """Count visits and hits; list the cells whose state may have changed, and return their number."""
    x0 = floor(laser[0])
    y0 = floor(laser[1])
    found = 0
    tile_row = -1
    tile_column = -1
    tile = -1
    for i in range(len(ends)):
        x, y = x0, y0
        x1 = floor(ends[i, 0])
        y1 = floor(ends[i, 1])
        step_x = 1 if x1 > x0 else -1
        step_y = 1 if y1 > y0 else -1
        dx = abs(x1 - x0)
        dy = abs(y1 - y0)
        n = max(dx, dy)
        sum_x = n
        sum_y = n
        for _ in range(n):
            if y >> SHIFT != tile_row or x >> SHIFT != tile_column:
                tile_row = y >> SHIFT
                tile_column = x >> SHIFT
                tile = own_tile(table, counts, points, owner, references, free, state, tile_row, tile_column)
            place = ((y & MASK) << SHIFT) | (x & MASK)
            counts[tile, place, 1] += 1
            if owner[tile, place] == SELF:
                touched[found, 0] = x
                touched[found, 1] = y
                found += 1
            sum_x += 2 * dx
            if sum_x >= 2 * n:
                sum_x -= 2 * n
                x += step_x
            sum_y += 2 * dy
            if sum_y >= 2 * n:
                sum_y -= 2 * n
                y += step_y
        if hit[i]:
            tile_row = y1 >> SHIFT
            tile_column = x1 >> SHIFT
            tile = own_tile(table, counts, points, owner, references, free, state, tile_row, tile_column)
            place = ((y1 & MASK) << SHIFT) | (x1 & MASK)
            counts[tile, place, 0] += 1
            counts[tile, place, 1] += 1
            mean_x = float(points[tile, place, 0])
            mean_y = float(points[tile, place, 1])
            points[tile, place, 0] = mean_x + (ends[i, 0] - x1 - 0.5 - mean_x) / counts[tile, place, 0]
            points[tile, place, 1] = mean_y + (ends[i, 1] - y1 - 0.5 - mean_y) / counts[tile, place, 0]
            touched[found, 0] = x1
            touched[found, 1] = y1
            found += 1
    return found


@helper
def _settle(
    table: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    touched: NDArray[np.int64],
    found: int,
) -> None:
    """Add the cells that became occupied, then remove those that no longer are."""
    for addition in (True, False):
        for i in range(found):
            x, y = touched[i, 0], touched[i, 1]
            tile = table[y >> SHIFT, x >> SHIFT]
            place = ((y & MASK) << SHIFT) | (x & MASK)
            hits = counts[tile, place, 0]
            occupied = hits > 0 and hits * VISITS_PER_HIT >= counts[tile, place, 1]
            was = owner[tile, place] == SELF
            if addition and occupied and not was:
                _add(table, counts, points, owner, references, free, state, x, y)
            elif not addition and was and not occupied:
                _remove(table, counts, points, owner, references, free, state, x, y)


@helper
def _steps(laser: NDArray[np.float64], ends: NDArray[np.float64]) -> int:
    """Return how many cells the beams have, at most."""
    total = 0
    for i in range(len(ends)):
        along_x = abs(floor(ends[i, 0]) - floor(laser[0]))
        along_y = abs(floor(ends[i, 1]) - floor(laser[1]))
        total += 1 + max(along_x, along_y)
    return total


@kernel(
    "void(int32[:,:,::1], int32[:,:,::1], float32[:,:,::1], uint8[:,::1], int32[::1], int32[::1], int64[::1],"
    " float64[:,::1], float64[:,:,::1], uint8[::1])",
    numpy=register_numpy,
)
def register(
    tables: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    lasers: NDArray[np.float64],
    ends: NDArray[np.float64],
    hit: NDArray[np.uint8],
) -> None:
    """Draw beams into all maps.

    Args:
        tables: shape (maps, rows, columns), and the other arrays of a :class:`TileStore`.
        counts: See TileStore.
        points: See TileStore.
        owner: See TileStore.
        references: See TileStore.
        free: See TileStore.
        state: See TileStore.
        lasers: shape (maps, 2): where the beams begin, in cells of the tables.
        ends: shape (maps, N, 2): where they end.
        hit: shape (N,): whether something is there.
    """
    for number in range(len(tables)):
        table = tables[number]
        touched = np.empty((_steps(lasers[number], ends[number]), 2), np.int64)
        found = _trace(
            table, counts, points, owner, references, free, state, lasers[number], ends[number], hit, touched
        )
        _settle(table, counts, points, owner, references, free, state, touched, found)
        for i in range(len(hit)):
            if hit[i]:
                _set_normal(table, points, owner, floor(ends[number, i, 0]), floor(ends[number, i, 1]))
