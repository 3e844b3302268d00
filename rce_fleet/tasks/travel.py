"""How far it is from everywhere to a cell, kept for each cell until the map changes."""

from __future__ import annotations

from collections import OrderedDict
from math import inf
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.tasks.records import Zone

    Floats = NDArray[np.float32]

MOST_BYTES = 128_000_000
"""Memory of the distances that are kept: on a map of 10 000 cells those to 3000 cells, more than the stops of
1000 open deliveries. With less than all stops need, each step would compute all of them anew."""
REFRESHED = 16
"""After a change of the map so many distances are computed anew in each step, and those from before count
until then: they differ by a detour. Computing all at once would stop the manager for a second."""


class TravelCosts:
    """Distances on the map, in metres that count as the robots' zones make them.

    A robot may leave a cell that is shut, and may not enter one.
    """

    def __init__(self) -> None:
        self._grid: GridMap | None = None
        self._shut: frozenset[int] = frozenset()
        self._revision: object = None
        self._zones: dict[str, tuple[int, ...]] = {}
        self._graphs: dict[tuple[tuple[str, float], ...], csr_array] = {}
        self._fields: OrderedDict[tuple[int, tuple[tuple[str, float], ...]], Floats] = OrderedDict()
        self._stale: dict[tuple[int, tuple[tuple[str, float], ...]], Floats] = {}
        self._budget = REFRESHED

    def begin_step(self) -> None:
        """Allow that some more distances of the map before are computed anew."""
        self._budget = REFRESHED

    def set_map(
        self, grid: GridMap, shut: frozenset[int], zones: Mapping[str, Zone], revision: object
    ) -> None:
        """Take a map over, unless it has the revision of the present one.

        Args:
            grid: The grid.
            shut: Cells that no robot may enter; walls among them.
            zones: Zones, by name.
            revision: Differs for different maps.
        """
        cells = {name: zone.cells for name, zone in zones.items()}
        if revision == self._revision and cells == self._zones and grid is self._grid:
            return
        self._stale = {**self._stale, **self._fields} if grid is self._grid else {}
        self._grid, self._shut, self._revision, self._zones = grid, shut, revision, cells
        self._graphs.clear()
        self._fields.clear()

    @property
    def has_map(self) -> bool:
        """Whether distances are known."""
        return self._grid is not None

    def metres(self, start: int, goal: int, zone_cost: Mapping[str, float] | None = None) -> float:
        """Return the length of the way from one cell to another; ``inf`` if there is none."""
        field = self.field(goal, zone_cost)
        return float(field[start]) if 0 <= start < len(field) else inf

    def field(self, goal: int, zone_cost: Mapping[str, float] | None = None) -> Floats:
        """Return the length of the way to a cell from each cell, shape (cells,); ``inf`` if there is none.

        Args:
            goal: The cell.
            zone_cost: How much a metre in a zone counts, by zone's name; ``inf``: it cannot be entered.
        """
        if self._grid is None:
            return np.zeros(0, np.float32)
        costs = tuple(sorted((zone_cost or {}).items()))
        field = self._fields.get((goal, costs))
        if field is None:
            stale = self._stale.get((goal, costs))
            if stale is not None and self._budget <= 0 and self._can_enter(goal, costs):
                return stale
            self._budget -= stale is not None
            self._stale.pop((goal, costs), None)
            field = self._compute(self._grid, goal, costs)
            self._fields[goal, costs] = field
            while (len(self._fields) + len(self._stale)) * field.nbytes > MOST_BYTES and self._forget():
                pass
        else:
            self._fields.move_to_end((goal, costs))
        return field

    def _forget(self) -> bool:
        """Forget the distances that were not used for the longest time; return whether there were some."""
        if self._stale:
            del self._stale[next(iter(self._stale))]
        elif len(self._fields) > 1:
            self._fields.popitem(last=False)
        else:
            return False
        return True

    def nearest(
        self, start: int, goals: Iterable[int], zone_cost: Mapping[str, float] | None = None
    ) -> int | None:
        """Return which of some cells is nearest; None if no way leads to any."""
        found = [(self.metres(start, goal, zone_cost), goal) for goal in goals]
        distance, goal = min(found, default=(inf, -1))
        return goal if distance < inf else None

    def _can_enter(self, goal: int, costs: tuple[tuple[str, float], ...]) -> bool:
        forbidden = (name for name, factor in costs if factor == inf)
        return goal not in self._shut and not any(goal in self._zones.get(name, ()) for name in forbidden)

    def _compute(self, grid: GridMap, goal: int, costs: tuple[tuple[str, float], ...]) -> Floats:
        if goal not in grid or not self._can_enter(goal, costs):
            return np.full(len(grid), inf, np.float32)
        graph = self._graphs.get(costs)
        if graph is None:
            graph = self._graphs[costs] = self._graph(grid, costs)
        return np.asarray(dijkstra(graph, indices=goal), np.float32)

    def _graph(self, grid: GridMap, costs: tuple[tuple[str, float], ...]) -> csr_array:
        """Return the graph of ways backwards: an edge from each free cell to the cells around it."""
        cells = np.arange(len(grid), dtype=np.int32).reshape(grid.rows, grid.columns)
        pairs = [(cells[:, 1:], cells[:, :-1]), (cells[1:], cells[:-1])]
        heads = np.concatenate([side.ravel() for a, b in pairs for side in (a, b)])
        tails = np.concatenate([side.ravel() for a, b in pairs for side in (b, a)])
        free = np.ones(len(grid), bool)
        free[list(self._shut)] = False
        weight = np.full(len(grid), grid.cell_size, np.float64)
        for name, factor in costs:
            inside = [cell for cell in self._zones.get(name, ()) if cell in grid]
            if factor == inf:
                free[inside] = False
            else:
                weight[inside] *= factor
        keep = free[heads]
        heads, tails = heads[keep], tails[keep]
        return csr_array(((weight[heads] + weight[tails]) / 2, (heads, tails)), shape=(len(grid), len(grid)))
