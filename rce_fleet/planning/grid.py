"""The map of cells that robots drive on.

Cells are numbered row by row from 0: ``cell = row * columns + column``. Columns grow along x, rows
along y, and cell 0 begins at ``origin``. This is the layout of ``nav_msgs/OccupancyGrid``: with one
map pixel per cell, the index in its ``data`` is the cell number. A page that draws row 0 on top
therefore mirrors y (and headings with it).
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import cos, floor, inf, isfinite, sin
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator
    from typing import Self


@dataclass(frozen=True)
class GridMap:
    """Cells in rows and columns, some of them blocked. Immutable; changes make a new map.

    Attributes:
        rows: Number of rows, along y.
        columns: Number of columns, along x.
        cell_size: Edge of a cell, metres.
        origin: Outer corner of cell 0, ``(x, y)`` in metres.
        blocked: Cells that cannot be entered.
        yaw: Direction of the columns in the world, radians counter-clockwise from x.
    """

    rows: int = 8
    columns: int = 8
    cell_size: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    blocked: frozenset[int] = frozenset()
    yaw: float = 0.0

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"a map needs at least one row and one column, not {self.rows} x {self.columns}")
        if not 0 < self.cell_size < inf:
            raise ValueError(f"cell_size must be a positive number, not {self.cell_size}")
        if not all(map(isfinite, (*self.origin, self.yaw))):
            raise ValueError(f"origin and yaw must be finite numbers, not {self.origin} and {self.yaw}")
        size = len(self)
        outside = [cell for cell in self.blocked if not 0 <= cell < size]
        if outside:
            raise ValueError(f"blocked cells {sorted(outside)} are outside the map")

    def __len__(self) -> int:
        return self.rows * self.columns

    def __contains__(self, cell: object) -> bool:
        return isinstance(cell, int) and 0 <= cell < self.rows * self.columns

    @property
    def free(self) -> list[int]:
        """Cells that can be entered, ascending."""
        return [cell for cell in range(len(self)) if cell not in self.blocked]

    def with_blocked(self, cells: Iterable[int]) -> GridMap:
        """Return the same map with exactly these cells blocked."""
        return replace(self, blocked=frozenset(cells))

    @property
    def layout(self) -> str:
        """Size and place of the cells as text, without what is blocked; for :meth:`from_layout`."""
        place = (self.rows, self.columns, *map(float, (self.cell_size, *self.origin, self.yaw)))
        return json.dumps(dict(zip(_LAYOUT, place, strict=True)))

    @classmethod
    def from_layout(cls, text: str) -> Self:
        """Return a grid without blocked cells from the text of :attr:`layout`.

        Raises:
            ValueError: The text is not that of a grid.
        """
        try:
            rows, columns, cell_size, x, y, yaw = (json.loads(text)[name] for name in _LAYOUT)
            return cls(int(rows), int(columns), float(cell_size), (float(x), float(y)), yaw=float(yaw))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"expected the layout of a grid ({', '.join(_LAYOUT)}), found {text!r}"
            ) from error

    # Numbers, places, metres

    def cell(self, row: int, column: int) -> int:
        """Return the number of the cell at ``row`` and ``column``."""
        return row * self.columns + column

    def place(self, cell: int) -> tuple[int, int]:
        """Return ``(row, column)`` of a cell."""
        return divmod(cell, self.columns)

    def centre(self, cell: int) -> tuple[float, float]:
        """Return the centre of a cell, ``(x, y)`` in metres."""
        row, column = self.place(cell)
        return self.point(row + 0.5, column + 0.5)

    def point(self, row: float, column: float) -> tuple[float, float]:
        """Return the point ``(x, y)`` in metres at a row and a column, which may be fractions."""
        along, up = column * self.cell_size, row * self.cell_size
        c, s = self._turn
        return self.origin[0] + c * along - s * up, self.origin[1] + s * along + c * up

    def cell_at(self, x: float, y: float) -> int | None:
        """Return the cell of a point in metres; ``None`` outside the map."""
        along, up = self._from_corner(x, y)
        column, row = floor(along / self.cell_size), floor(up / self.cell_size)
        if 0 <= row < self.rows and 0 <= column < self.columns:
            return self.cell(row, column)
        return None

    def cells_touched(self, x: float, y: float, radius: float) -> set[int]:
        """Return the cells of the map that a disc overlaps; all in metres."""
        size = self.cell_size
        along, up = self._from_corner(x, y)
        left, right = floor((along - radius) / size), floor((along + radius) / size)
        low, high = floor((up - radius) / size), floor((up + radius) / size)
        touched = set()
        for row in range(max(low, 0), min(high, self.rows - 1) + 1):
            for column in range(max(left, 0), min(right, self.columns - 1) + 1):
                dx = max(abs(along - (column + 0.5) * size) - size / 2, 0.0)
                dy = max(abs(up - (row + 0.5) * size) - size / 2, 0.0)
                if dx * dx + dy * dy < radius * radius:
                    touched.add(self.cell(row, column))
        return touched

    @cached_property
    def _turn(self) -> tuple[float, float]:
        """Cosine and sine of the direction of the columns."""
        return cos(self.yaw), sin(self.yaw)

    def _from_corner(self, x: float, y: float) -> tuple[float, float]:
        """Return how far a point is from the outer corner of cell 0, along columns and rows, metres."""
        dx, dy = x - self.origin[0], y - self.origin[1]
        c, s = self._turn
        return c * dx + s * dy, c * dy - s * dx

    # Neighbours

    def around(self, cell: int) -> Iterator[int]:
        """Return the cells that share an edge with ``cell``, blocked or not, ascending."""
        row, column = self.place(cell)
        if row > 0:
            yield cell - self.columns
        if column > 0:
            yield cell - 1
        if column < self.columns - 1:
            yield cell + 1
        if row < self.rows - 1:
            yield cell + self.columns

    @cached_property
    def neighbours(self) -> tuple[tuple[int, ...], ...]:
        """For every cell, blocked ones too, the free cells that share an edge with it."""
        blocked = self.blocked
        return tuple(
            tuple(other for other in self.around(cell) if other not in blocked) for cell in range(len(self))
        )

    def adjacent(self, a: int, b: int) -> bool:
        """Return whether two cells share an edge."""
        (row_a, column_a), (row_b, column_b) = self.place(a), self.place(b)
        return abs(row_a - row_b) + abs(column_a - column_b) == 1

    def is_path(self, cells: Iterable[int]) -> bool:
        """Return whether every cell shares an edge with the one before it."""
        return all(self.adjacent(a, b) for a, b in pairwise(cells))

    def adjacent_moves(self, moves: Iterable[tuple[int, int]]) -> frozenset[tuple[int, int]]:
        """Return those of some moves ``(from, to)`` that lead from a cell of the grid to one beside it."""
        return frozenset(
            (start, end)
            for start, end in moves
            if start in self and end in self and self.adjacent(start, end)
        )

    def moves_by(self, offset: int, cells: Iterable[int]) -> frozenset[tuple[int, int]]:
        """Return the moves ``(from, to)`` by a difference of cell numbers that touch some cells."""
        return self.adjacent_moves(
            move for cell in cells for move in ((cell, cell + offset), (cell - offset, cell))
        )

    # Connectivity

    def reachable(self, start: int) -> set[int]:
        """Return the free cells that can be reached from ``start``, with ``start`` itself."""
        seen = {start}
        queue = deque(seen)
        while queue:
            for other in self.neighbours[queue.popleft()]:
                if other not in seen:
                    seen.add(other)
                    queue.append(other)
        return seen

    def connected(self, cells: Collection[int] | None = None) -> bool:
        """Return whether these free cells (by default all) are connected over free cells."""
        wanted = set(self.free if cells is None else cells)
        if not wanted:
            return True
        return wanted.isdisjoint(self.blocked) and wanted <= self.reachable(next(iter(wanted)))


_LAYOUT = ("rows", "columns", "cell_size", "x", "y", "yaw")
"""Keys of a grid's layout."""
