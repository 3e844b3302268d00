"""Draws scans into maps of tiles, in numpy; gives the same as :mod:`rce_fleet.mapping.draw_kernels`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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

    Cells = NDArray[np.int64]
    _Storage = tuple[
        NDArray[np.int32],
        NDArray[np.int32],
        NDArray[np.float32],
        NDArray[np.uint8],
        NDArray[np.int32],
        NDArray[np.int32],
        NDArray[np.int64],
    ]


def _owned_tiles(
    table: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    x: Cells,
    y: Cells,
) -> Cells:
    """Return tiles for writing of many cells."""
    keys = (y >> SHIFT) * table.shape[1] + (x >> SHIFT)
    for key in np.unique(keys):
        row, column = divmod(int(key), table.shape[1])
        own_tile(table, counts, points, owner, references, free, state, row, column)
    return np.asarray(table[y >> SHIFT, x >> SHIFT], np.int64)


def _place(x: Cells, y: Cells) -> Cells:
    return np.asarray(((y & MASK) << SHIFT) | (x & MASK), np.int64)


def _line_cells(start: Cells, end: Cells) -> tuple[Cells, Cells, Cells]:
    """Return column, row and ray of the cells on lines, without their ends."""
    delta = end - start
    steps = np.abs(delta).max(axis=1)
    ray = np.repeat(np.arange(len(end)), steps)
    k = np.arange(len(ray)) - np.repeat(np.cumsum(steps) - steps, steps)
    n = steps[ray]
    moved = (2 * k[:, None] * np.abs(delta[ray]) + n[:, None]) // (2 * n[:, None])
    cells = start + np.sign(delta[ray]) * moved
    return cells[:, 0], cells[:, 1], ray


def _register_one(
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
) -> None:
    storage = (table, counts, points, owner, references, free, state)
    cells = np.floor(ends).astype(np.int64)
    x, y, _ = _line_cells(np.floor(laser).astype(np.int64), cells)
    tiles = _owned_tiles(*storage, x, y)
    np.add.at(counts[..., 1], (tiles, _place(x, y)), 1)
    passed = owner[tiles, _place(x, y)] == SELF
    was_hit = hit > 0
    hit_x, hit_y = cells[was_hit].T
    tiles = _owned_tiles(*storage, hit_x, hit_y)
    places = _place(hit_x, hit_y)
    inside = ends[was_hit] - cells[was_hit] - 0.5
    for tile, place, point in zip(tiles, places, inside, strict=True):
        counts[tile, place] += 1
        mean = points[tile, place, :2].astype(np.float64)
        points[tile, place, :2] = mean + (point - mean) / counts[tile, place, 0]
    touched = np.unique(np.column_stack((np.r_[x[passed], hit_x], np.r_[y[passed], hit_y])), axis=0)
    tiles, places = table[touched[:, 1] >> SHIFT, touched[:, 0] >> SHIFT], _place(*touched.T)
    hits, visits = counts[tiles, places].T
    occupied = (hits > 0) & (hits * VISITS_PER_HIT >= visits)
    was = owner[tiles, places] == SELF
    for cell in touched[occupied & ~was]:
        _add_numpy(storage, int(cell[0]), int(cell[1]))
    for cell in touched[~occupied & was]:
        _remove_numpy(storage, int(cell[0]), int(cell[1]))
    _normals_numpy(storage, np.unique(np.column_stack((hit_x, hit_y)), axis=0))


_AROUND = np.array(
    [
        (dx, dy)
        for dy in range(-REACH, REACH + 1)
        for dx in range(-REACH, REACH + 1)
        if dx * dx + dy * dy <= REACH**2
    ]
)


def _add_numpy(storage: _Storage, column: int, row: int) -> None:
    table, counts, points, owner, references, free, state = storage
    x, y = column + _AROUND[:, 0], row + _AROUND[:, 1]
    tiles = _owned_tiles(table, counts, points, owner, references, free, state, x, y)
    codes = 1 + (REACH - _AROUND[:, 1]) * SPAN + REACH - _AROUND[:, 0]
    places = _place(x, y)
    nearer = RANKS[codes] < RANKS[owner[tiles, places]]
    owner[tiles[nearer], places[nearer]] = codes[nearer]


def _remove_numpy(storage: _Storage, column: int, row: int) -> None:
    table, counts, points, owner, references, free, state = storage
    offsets = np.arange(-2 * REACH, 2 * REACH + 1)
    near_y, near_x = (part.ravel() for part in np.meshgrid(row + offsets, column + offsets, indexing="ij"))
    tiles = table[near_y >> SHIFT, near_x >> SHIFT]
    is_self = (tiles >= 0) & (owner[tiles, _place(near_x, near_y)] == SELF)
    is_self &= (near_x != column) | (near_y != row)
    near_x, near_y = near_x[is_self], near_y[is_self]
    x, y = column + _AROUND[:, 0], row + _AROUND[:, 1]
    tiles = _owned_tiles(table, counts, points, owner, references, free, state, x, y)
    codes = 1 + (REACH - _AROUND[:, 1]) * SPAN + REACH - _AROUND[:, 0]
    lost = owner[tiles, _place(x, y)] == codes
    x, y, tiles = x[lost], y[lost], tiles[lost]
    dx, dy = near_x[None] - x[:, None], near_y[None] - y[:, None]
    within = dx * dx + dy * dy <= REACH * REACH
    found = np.where(within, 1 + (dy + REACH) * SPAN + dx + REACH, 0)
    best = np.zeros(len(x), np.int64)
    if found.shape[1]:
        best = found[np.arange(len(x)), RANKS[found].argmin(axis=1)]
    owner[tiles, _place(x, y)] = best


def _normals_numpy(storage: _Storage, cells: Cells) -> None:
    table, _, points, owner, *_ = storage
    offsets = np.arange(-NORMAL_REACH, NORMAL_REACH + 1)
    dy, dx = (part.ravel() for part in np.meshgrid(offsets, offsets, indexing="ij"))
    x, y = cells[:, :1] + dx, cells[:, 1:] + dy
    tiles, places = table[y >> SHIFT, x >> SHIFT], _place(x, y)
    used = (tiles >= 0) & (owner[tiles, places] == SELF)
    px = (points[tiles, places, 0].astype(np.float64) + dx) * used
    py = (points[tiles, places, 1].astype(np.float64) + dy) * used
    number = np.maximum(used.sum(axis=1), 1)
    mx, my = px.sum(axis=1) / number, py.sum(axis=1) / number
    sxx = (px * px).sum(axis=1) / number - mx * mx
    syy = (py * py).sum(axis=1) / number - my * my
    sxy = (px * py).sum(axis=1) / number - mx * my
    root = np.sqrt((sxx - syy) ** 2 / 4 + sxy * sxy)
    small, large = (sxx + syy) / 2 - root, (sxx + syy) / 2 + root
    line = (number >= LINE_POINTS) & (small <= LINE_RATIO * large)
    angle = 0.5 * np.arctan2(2 * sxy, sxx - syy)
    own = len(dx) // 2
    points[tiles[:, own], places[:, own], 2] = np.where(line, -np.sin(angle), 0.0)
    points[tiles[:, own], places[:, own], 3] = np.where(line, np.cos(angle), 0.0)


def register_numpy(
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
    """Draw beams into all maps; see :func:`rce_fleet.mapping.draw_kernels.register`."""
    for table, laser, places in zip(tables, lasers, ends, strict=True):
        _register_one(table, counts, points, owner, references, free, state, laser, places, hit)
