"""Lane graphs: the ways on a grid that robots may drive, each with directions, speed and width. Pure.

A lane runs over cells of the grid, from one to the next. With a lane graph robots make only the moves of its
lanes, and cells that are on no lane are walls. Cells keep their numbers, so everything that knows the grid
works as before: :meth:`LaneGraph.restrict` is its grid, :meth:`LaneGraph.closed` and :attr:`LaneGraph.costs`
are for :meth:`rce_fleet.planning.graph.PlanningGraph.from_grid`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import LanesError
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.guidance import DOWN, LEFT, RIGHT, UP

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap

NOMINAL_SPEED = 0.5
"""Speed of robots where nothing limits it, metres per second, when costs are computed from speeds."""
MOST_COST = 20
"""A move counts at most so much in plans. Paths of single robots are found as if it took so many steps."""


@dataclass(frozen=True, slots=True)
class Lane:
    """A way over cells that share edges.

    Attributes:
        name: For people.
        cells: Its cells in order, at least two; those between its nodes too.
        one_way: Whether robots drive it only in the order of the cells.
        speed: Greatest speed on it, metres per second; 0: not limited.
        width: Its width, metres; 0: every robot fits.
        cost: How much a move on it counts, 1 .. 20; more where plans should prefer other ways.
    """

    name: str
    cells: tuple[int, ...]
    one_way: bool = False
    speed: float = 0.0
    width: float = 0.0
    cost: int = 1

    def moves(self) -> Iterable[tuple[int, int]]:
        """Return the moves ``(from, to)`` that robots may make on it."""
        there = pairwise(self.cells)
        return there if self.one_way else chain(there, pairwise(reversed(self.cells)))


@dataclass(frozen=True)
class LaneGraph:
    """The lanes of a grid.

    Attributes:
        lanes: The lanes; no two of them have the same move.

    Raises:
        LanesError: Two lanes have the same move, or a lane has fewer than two cells.
    """

    lanes: tuple[Lane, ...]

    def __post_init__(self) -> None:
        first: dict[tuple[int, int], Lane] = {}
        for lane in self.lanes:
            if len(lane.cells) < 2:  # noqa: PLR2004 - a move has two cells
                raise LanesError(f"lane {lane.name!r} has {len(lane.cells)} cells: it needs at least two")
            for move in lane.moves():
                other = first.setdefault(move, lane)
                if other is not lane:
                    raise LanesError(
                        f"lanes {other.name!r} and {lane.name!r} both lead from cell {move[0]} to cell"
                        f" {move[1]}: end one of them before it"
                    )

    @cached_property
    def cells(self) -> frozenset[int]:
        """Cells that are on a lane."""
        return frozenset(cell for lane in self.lanes for cell in lane.cells)

    @cached_property
    def moves(self) -> Mapping[tuple[int, int], Lane]:
        """The lane of each move ``(from, to)`` that robots may make."""
        return {move: lane for lane in self.lanes for move in lane.moves()}

    @cached_property
    def costs(self) -> Mapping[tuple[int, int], int]:
        """How much moves ``(from, to)`` count that do not count 1.

        On the fastest lane of all a move counts 1, times the lane's cost; on a lane with half its speed
        twice as much. A lane without a speed is as fast as the fastest, and as :data:`NOMINAL_SPEED`.
        """
        fastest = max((lane.speed or NOMINAL_SPEED for lane in self.lanes), default=NOMINAL_SPEED)
        found = {}
        for move, lane in self.moves.items():
            slower = round(fastest / (lane.speed or fastest))
            cost = min(max(slower, 1) * lane.cost, MOST_COST)
            if cost > 1:
                found[move] = cost
        return found

    def check(self, grid: GridMap) -> None:
        """Check that the lanes can be driven on a grid.

        Raises:
            LanesError: A lane leads out of the map, through a wall, or to a cell that is not the next one.
        """
        for lane in self.lanes:
            for cell in lane.cells:
                if cell not in grid:
                    raise LanesError(
                        f"lane {lane.name!r}: cell {cell} is not on the map of {len(grid)} cells"
                    )
                if cell in grid.blocked:
                    raise LanesError(
                        f"lane {lane.name!r} leads through cell {cell}, which is a wall: lead it around"
                    )
            for start, end in pairwise(lane.cells):
                if not grid.adjacent(start, end):
                    raise LanesError(
                        f"lane {lane.name!r} leads from cell {start} to cell {end}, which is not beside it"
                    )

    def restrict(self, grid: GridMap) -> GridMap:
        """Return the grid with cells that are on no lane blocked."""
        return grid.with_blocked(cell for cell in range(len(grid)) if cell not in self.cells)

    def closed(self, grid: GridMap) -> frozenset[tuple[int, int]]:
        """Return the moves between cells beside each other on lanes that no lane leads along."""
        moves = self.moves
        return frozenset(
            (cell, other)
            for cell in self.cells
            for other in grid.around(cell)
            if other in self.cells and (cell, other) not in moves
        )

    def factors(self, grid: GridMap, starts: NDArray[np.int32], ends: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return how much moves between neighbours count; 0: no lane leads along.

        Args:
            grid: The grid of the lanes.
            starts: Cell where each move begins, shape (moves,). A cell on no lane can be left anywhere.
            ends: Cell where it ends, shape (moves,).
        """
        table = move_costs(np.ones(len(grid), np.int32), self.costs, grid)
        for start, end in self.closed(grid):
            table[start, _direction(end - start, grid)] = 0
        directions = np.select(
            [ends - starts == offset for offset in (grid.columns, -grid.columns, 1)], [UP, DOWN, RIGHT], LEFT
        )
        found: NDArray[np.int32] = table[starts, directions]
        return found

    def connected_part(self) -> frozenset[int]:
        """Return the most cells from each of which lanes lead to all others: a robot there can go on."""
        from scipy.sparse import csr_array  # long to load, needed only to choose starts and goals
        from scipy.sparse.csgraph import connected_components

        cells = np.array(sorted(self.cells))
        starts, ends = np.searchsorted(cells, np.array(list(self.moves)).T)
        graph = csr_array((np.ones(len(starts), np.int8), (starts, ends)), shape=(len(cells), len(cells)))
        _, labels = connected_components(graph, connection="strong")
        return frozenset(map(int, cells[labels == np.bincount(labels).argmax()]))

    def speed_limit(self, cells: Sequence[int]) -> float:
        """Return the greatest speed on a way over some cells, metres per second; infinity without a limit."""
        lanes = (self.moves.get(move) for move in pairwise(cells))
        return min((lane.speed for lane in lanes if lane is not None and lane.speed), default=inf)

    def fitting(self, width: float) -> tuple[LaneGraph, tuple[Lane, ...]]:
        """Return the graph of the lanes that are wide enough, and the lanes that are not.

        Args:
            width: Width of the robots, metres.
        """
        narrow = tuple(lane for lane in self.lanes if lane.width and lane.width < width)
        return LaneGraph(tuple(lane for lane in self.lanes if lane not in narrow)), narrow

    def graph(self, grid: GridMap) -> PlanningGraph:
        """Return the graph of the lanes on a grid, for planners."""
        costs = move_costs(np.ones(len(grid), np.int32), self.costs, grid)
        return PlanningGraph.from_grid(self.restrict(grid), costs=costs, closed=self.closed(grid))


def move_costs(
    cells: NDArray[np.int32], moves: Mapping[tuple[int, int], int], grid: GridMap
) -> NDArray[np.int32]:
    """Return the cost of each move on a grid: that of its lane or of the cell, whichever is more.

    Args:
        cells: Cost of entering each cell, shape (cells,).
        moves: Cost of moves ``(from, to)`` on lanes, where it is not 1.
        grid: The grid.

    Returns:
        Cost of leaving each cell down, left, right and up, shape (cells, 4).
    """
    offsets = np.array([-grid.columns, -1, 1, grid.columns])
    targets = np.clip(np.arange(len(grid))[:, None] + offsets, 0, len(grid) - 1)
    found: NDArray[np.int32] = cells[targets]
    for (start, end), cost in moves.items():
        direction = _direction(end - start, grid)
        found[start, direction] = max(found[start, direction], cost)
    return found


def _direction(offset: int, grid: GridMap) -> int:
    """Return the direction of a move by the difference of cell numbers."""
    return {-1: LEFT, 1: RIGHT, -grid.columns: DOWN, grid.columns: UP}[offset]
