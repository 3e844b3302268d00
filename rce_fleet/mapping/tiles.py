"""Storage of the maps of many particles: tiles that maps share until one of them writes.

A map is a table of tile numbers. Copying a map copies its table; a tile that several maps use is copied when
one of them changes it. All maps of a :class:`TileStore` lie in one frame of cells and grow together.

A cell has how often beams ended in it (hits) and reached or passed it (visits), the mean of the points in it
and the direction of the wall there, and the offset of the nearest occupied cell within :data:`REACH`. A cell
is occupied if it was hit in at least one of :data:`VISITS_PER_HIT` visits, so what has gone disappears.
"""

from __future__ import annotations

import mmap
from typing import TYPE_CHECKING, Any

import numpy as np

from rce_fleet.exceptions import MapError

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHIFT = 5
TILE = 1 << SHIFT
"""Cells along the edge of a tile."""
MASK = TILE - 1
AREA = TILE * TILE
REACH = 6
"""Cells from which the nearest occupied cell is known."""
SPAN = 2 * REACH + 1
SELF = 1 + REACH * SPAN + REACH
"""Code of a cell that is itself occupied. Code ``1 + (dy + REACH) * SPAN + dx + REACH`` stands for the
occupied cell dx columns and dy rows away; 0 for none within reach."""
VISITS_PER_HIT = 10
NORMAL_REACH = 2
"""Cells around one from which the direction of its wall is taken."""
LINE_RATIO = 0.15
"""The points around form a line if their variance across it is at most this share of that along it."""
LINE_POINTS = 3
MARGIN = 2 * REACH + 2
"""Cells around what is written that a table must have."""
MAX_TILES = 1 << 22
"""Tiles of one map's table, a square of 3 km at 5 cm; beyond, readings or odometry are wrong."""


def _ranks() -> NDArray[np.int32]:
    """Return the order of codes: the nearest first; equally near ones by code."""
    codes = np.arange(SPAN * SPAN)
    squares = (codes // SPAN - REACH) ** 2 + (codes % SPAN - REACH) ** 2
    ranks = np.full(SPAN * SPAN + 1, np.iinfo(np.int32).max, np.int32)
    ranks[1:] = np.where(squares <= REACH * REACH, squares * SPAN * SPAN + codes, ranks[0] - 1)
    return ranks


RANKS = _ranks()


class _Memory:
    """Memory of an array that grows without being copied; what is new is 0 and takes space when written."""

    def __init__(self, *shape: int, dtype: type[np.generic]) -> None:
        self._shape = shape
        self._dtype = np.dtype(dtype)
        self._row = int(np.prod(shape)) * self._dtype.itemsize
        self._space = mmap.mmap(-1, self._row, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)

    def array(self, rows: int) -> NDArray[Any]:
        """Return an array of shape (rows, ...).

        Raises:
            BufferError: It has to grow, and an array that was returned before still exists.
        """
        if rows * self._row > len(self._space):
            self._space.resize(rows * self._row)
        if not rows:
            return np.empty((0, *self._shape), self._dtype)
        values = np.frombuffer(self._space, self._dtype, rows * int(np.prod(self._shape)))
        return values.reshape(rows, *self._shape)


class TileStore:
    """The maps of a set of particles.

    Attributes:
        resolution: Edge of a cell, metres.
        origin: ``(column, row)`` of the tables' first cell; the world's origin is the corner of cell (0, 0).
        tables: shape (maps, rows, columns), int32: number of the tile, -1 where nothing was seen.
        counts: shape (tiles, AREA, 2), int32: hits and visits of each cell.
        points: shape (tiles, AREA, 4), float32: mean of the points from the cell's centre, in cells; normal
            of the wall, (0, 0) where the points around form no line.
        owner: shape (tiles, AREA), uint8: code of the nearest occupied cell.
        references: shape (tiles,), int32: tables that use the tile.
        free: shape (tiles,), int32: numbers of unused tiles, the first ``state[0]`` of them.
        state: shape (1,), int64.
    """

    def __init__(self, maps: int, resolution: float) -> None:
        self.resolution = resolution
        self.origin = (-TILE, -TILE)
        self.tables = np.full((maps, 2, 2), -1, np.int32)
        self._memory = (
            _Memory(AREA, 2, dtype=np.int32),
            _Memory(AREA, 4, dtype=np.float32),
            _Memory(AREA, dtype=np.uint8),
        )
        self.counts, self.points, self.owner = (each.array(0) for each in self._memory)
        self.references = np.zeros(0, np.int32)
        self.free = np.zeros(0, np.int32)
        self.state = np.zeros(1, np.int64)

    @property
    def tiles(self) -> int:
        """Tiles that are in use."""
        return len(self.references) - int(self.state[0])

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points, shape (..., 2) in metres, in cells from the tables' first corner."""
        return np.asarray(points / self.resolution - self.origin, np.float64)

    def cover(self, points: NDArray[np.float64]) -> None:
        """Grow all tables so that they have these points, shape (N, 2) in metres, and a margin around them.

        Raises:
            MapError: If the map would become larger than any floor: odometry or readings are wrong.
        """
        low = np.floor(points.min(axis=0) / self.resolution).astype(np.int64) - MARGIN
        high = np.floor(points.max(axis=0) / self.resolution).astype(np.int64) + MARGIN
        _, rows, columns = self.tables.shape
        first = np.array(self.origin)
        size = np.array((columns, rows))
        before = np.maximum(-((low - first) // TILE), 0)
        after = np.maximum((high - first) // TILE + 1 - size, 0)
        if not (before.any() or after.any()):
            return
        grown = size + before + after
        if int(grown.prod()) > MAX_TILES:
            raise MapError(
                f"the map would become {grown[0] * TILE * self.resolution:.0f} x "
                f"{grown[1] * TILE * self.resolution:.0f} m: odometry or readings are wrong"
            )
        # Some more on the sides that grow, so that tables are not copied with each scan.
        before, after = before + (before > 0) * 4, after + (after > 0) * 4
        self.tables = np.pad(
            self.tables, ((0, 0), (before[1], after[1]), (before[0], after[0])), constant_values=-1
        )
        self.origin = (int(first[0] - before[0] * TILE), int(first[1] - before[1] * TILE))

    def reserve(self, points: NDArray[np.float64]) -> None:
        """Make room for the tiles that each map needs to write in the box around its points.

        Args:
            points: shape (maps, N, 2), metres.
        """
        sides = points.max(axis=1) - points.min(axis=1) + 2 * MARGIN * self.resolution
        tiles = (np.ceil(sides / (TILE * self.resolution)) + 1).prod(axis=1)
        missing = int(tiles.sum()) - int(self.state[0])
        if missing <= 0:
            return
        old = len(self.references)
        more = max(missing, old, 64)
        del self.counts, self.points, self.owner  # memory that is in use cannot grow
        self.counts, self.points, self.owner = (each.array(old + more) for each in self._memory)
        self.references = np.concatenate((self.references, np.zeros(more, np.int32)))
        unused = int(self.state[0])
        free = np.empty(old + more, np.int32)
        free[:unused] = self.free[:unused]
        free[unused : unused + more] = np.arange(old + more - 1, old - 1, -1)
        self.free = free
        self.state[0] = unused + more

    def choose(self, chosen: NDArray[np.int64]) -> None:
        """Replace the maps by copies of some of them, by number, shape (maps,)."""
        self.tables = np.ascontiguousarray(self.tables[chosen])
        used = self.tables[self.tables >= 0]
        references = np.bincount(used, minlength=len(self.references)).astype(np.int32)
        gone = np.flatnonzero((references == 0) & (self.references > 0))
        unused = int(self.state[0])
        self.free[unused : unused + len(gone)] = gone
        self.state[0] = unused + len(gone)
        self.references = references

    def only(self, number: int) -> TileStore:
        """Return a store of its own with a copy of one map."""
        table = self.tables[number]
        places = table >= 0
        picked = table[places]
        made = TileStore(1, self.resolution)
        made.origin = self.origin
        made.tables = np.full((1, *table.shape), -1, np.int32)
        made.tables[0][places] = np.arange(len(picked))
        made.counts, made.points, made.owner = (each.array(len(picked)) for each in made._memory)
        made.counts[:], made.points[:] = self.counts[picked], self.points[picked]
        made.owner[:] = self.owner[picked]
        made.references = np.ones(len(picked), np.int32)
        made.free = np.zeros(len(picked), np.int32)
        return made

    def dense_counts(self, number: int) -> NDArray[np.int32]:
        """Return hits and visits of all cells of one map, shape (rows, columns, 2), from low y up."""
        table = self.tables[number]
        rows, columns = table.shape
        result = np.zeros((rows, TILE, columns, TILE, 2), np.int32)
        for row, column in np.argwhere(table >= 0):
            result[row, :, column] = self.counts[table[row, column]].reshape(TILE, TILE, 2)
        return result.reshape(rows * TILE, columns * TILE, 2)
