"""How far it is from everywhere to a cell, kept for each cell until the map changes."""

from __future__ import annotations

from collections import OrderedDict
from math import inf, isfinite
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.limits import LEAST_FACTOR
from rce_fleet.tasks.travel_loops import measure_ways

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.lanes import LaneGraph
    from rce_fleet.tasks.records import Zone

    Floats = NDArray[np.float32]
    Cells = NDArray[np.bool_]
    Costs = tuple[tuple[str, float], ...]
    """How much a metre in zones counts, by zone's name."""
    Graph = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]

CLOSES_MOVES = -inf
"""As a zone's cost: it is for this robot, and closes moves between its cells. A metre counts as elsewhere."""
MOST_BYTES = 128_000_000
"""Memory of the distances that are kept: on a map of 10 000 cells those to 3000 cells, more than the stops of
1000 open deliveries. With less than all stops need, each step would compute all of them anew."""
REFRESHED = 16
"""After a change of the map so many distances are computed anew in each step, and those from before count
until then: they differ by a detour. Computing all at once would stop the manager for a second."""
CELLS_PER_STEP = 160_000
"""Robots with zones of their own have distances of their own. In each step those to some cells are computed,
so many numbers in all, and at least :data:`REFRESHED` fields; the others are estimated until a later step."""
MOST_GRAPHS = 16
"""Graphs that are kept, those used last: one takes twelve times the memory of a field."""
_AT_ONCE = 64
"""So many distances are measured in one go by the compiled loop ..."""
_AT_ONCE_PLAIN = 16
"""... and without it, so that the manager answers after some milliseconds."""


class TravelCosts:
    """Distances on the map, in metres that count as the robots' zones make them.

    A robot may leave a cell that is shut, and may not enter one. Zones may close moves between cells:
    one-way zones and edges.

    With many sets of zones, the distances of all sets would take longer than a step and more memory than is
    kept. Those that are not computed yet are estimated: the distance without the zones that are the robot's
    own, and ``inf`` exactly where the cells that are shut to this robot leave no way. So an estimate lacks a
    detour at most, and never leads a robot to a cell that it cannot reach.

    Attributes:
        epoch: Grows when all distances are forgotten: with each new grid, and with other lanes.
        version: Grows with each change of the map, that of a cell or a zone too.
    """

    def __init__(self) -> None:
        self._grid: GridMap | None = None
        self._shut: frozenset[int] = frozenset()
        self._revision: object = None
        self._zones: dict[str, Zone] = {}
        self._lanes: LaneGraph | None = None
        self.epoch = 0
        self.version = 0
        self._graphs: OrderedDict[Costs, Graph] = OrderedDict()
        self._parts: dict[Costs, _Parts] = {}
        self._fields: OrderedDict[tuple[int, Costs], Floats] = OrderedDict()
        self._stale: dict[tuple[int, Costs], Floats] = {}
        self._budget = REFRESHED
        self._own_budget = REFRESHED

    def begin_step(self) -> None:
        """Allow that some more distances of the map before, and of robots' own zones, are computed."""
        self._budget = REFRESHED
        self._own_budget = max(REFRESHED, CELLS_PER_STEP // max(1, len(self._grid or ())))

    def set_map(
        self,
        grid: GridMap,
        shut: frozenset[int],
        zones: Mapping[str, Zone],
        revision: object,
        lanes: LaneGraph | None = None,
    ) -> None:
        """Take a map over, unless it has the revision of the present one.

        Args:
            grid: The grid.
            shut: Cells that no robot may enter; walls among them.
            zones: Zones, by name.
            revision: Differs for different maps.
            lanes: Lanes that robots keep to: metres on slow ones count more.
        """
        is_same = grid is self._grid and lanes == self._lanes
        if revision == self._revision and is_same and _rules(zones) == _rules(self._zones):
            return
        self._stale = {**self._stale, **self._fields} if is_same else {}
        self.epoch += not is_same
        self.version += 1
        self._lanes = lanes
        self._grid, self._shut, self._revision, self._zones = grid, shut, revision, dict(zones)
        self._graphs.clear()
        self._parts.clear()
        self._fields.clear()

    @property
    def has_map(self) -> bool:
        """Whether distances are known."""
        return self._grid is not None

    def metres(self, start: int, goal: int, zone_cost: Mapping[str, float] | None = None) -> float:
        """Return the length of the way from one cell to another; ``inf`` if there is none."""
        if self._grid is None or not 0 <= start < len(self._grid):
            return inf
        field, cut_off = self._look(self._grid, goal, _costs(zone_cost))
        return inf if cut_off is not None and cut_off[start] else float(field[start])

    def write_metres(
        self,
        cells: NDArray[np.int64],
        goal: int,
        zone_cost: Mapping[str, float] | None,
        out: Floats,
    ) -> None:
        """Write the length of the way from each of some cells to another one.

        Args:
            cells: Where the ways begin, shape (n,).
            goal: Where they end.
            zone_cost: See :meth:`field`.
            out: Lengths, shape (n,); written.
        """
        if self._grid is None:
            out[:] = inf
            return
        field, cut_off = self._look(self._grid, goal, _costs(zone_cost))
        field.take(cells, out=out, mode="clip")
        if cut_off is not None:
            out[cut_off.take(cells, mode="clip")] = inf

    def field(self, goal: int, zone_cost: Mapping[str, float] | None = None) -> Floats:
        """Return the length of the way to a cell from each cell, shape (cells,); ``inf`` if there is none.

        Args:
            goal: The cell.
            zone_cost: How much a metre in a zone counts, by zone's name; ``inf``: it cannot be entered;
                :data:`CLOSES_MOVES`.
        """
        if self._grid is None:
            return np.zeros(0, np.float32)
        field, cut_off = self._look(self._grid, goal, _costs(zone_cost))
        return field if cut_off is None else np.where(cut_off, np.float32(inf), field)

    def _look(self, grid: GridMap, goal: int, costs: Costs) -> tuple[Floats, Cells | None]:
        """Return distances to a cell, and from which cells no way leads there although a distance says so."""
        field = self._fields.get((goal, costs))
        if field is not None:
            self._fields.move_to_end((goal, costs))
            return field, None
        stale = self._stale.get((goal, costs))
        if stale is not None and self._budget <= 0 and self._can_enter(goal, costs):
            return stale, None
        if costs and stale is None:
            if self._own_budget <= 0:
                return self._estimate(grid, goal, costs)
            self._own_budget -= 1
        self._budget -= stale is not None
        self._stale.pop((goal, costs), None)
        (field,) = self._compute(grid, [goal], costs)
        self._keep(goal, costs, field)
        return field, None

    def _estimate(self, grid: GridMap, goal: int, costs: Costs) -> tuple[Floats, Cells | None]:
        """Return about what :meth:`_look` returns, from distances with fewer zones; see the class."""
        parts = self._parts.get(costs)
        if parts is None:
            closed = tuple((name, factor) for name, factor in costs if factor == inf)
            parts = self._parts[costs] = _Parts(grid, self._free(grid, ()), self._free(grid, closed))
            # Without closed zones, what remains is the cost zones themselves: their distances are missing.
            parts.counted = tuple((name, factor) for name, factor in costs if factor < inf) if closed else ()
        return self._look(grid, goal, parts.counted)[0], parts.cut_off(goal)

    @property
    def capacity(self) -> int:
        """How many cells' distances are kept at most."""
        return MOST_BYTES // (4 * max(1, len(self._grid or ())))

    @property
    def at_once(self) -> int:
        """How many cells' distances should be measured in one go."""
        return _AT_ONCE if measure_ways.is_compiled else _AT_ONCE_PLAIN

    def missing(self, goals: Iterable[int], zone_cost: Mapping[str, float] | None = None) -> list[int]:
        """Return those of some cells whose distances are not known, not even those before a cell was shut."""
        costs = _costs(zone_cost)
        return [
            goal
            for goal in dict.fromkeys(goals)
            if (goal, costs) not in self._fields and (goal, costs) not in self._stale
        ]

    def measure(self, goals: Sequence[int], zone_cost: Mapping[str, float] | None = None) -> None:
        """Compute the distances to some cells together, which takes a fraction of the time."""
        if self._grid is not None:
            costs = _costs(zone_cost)
            for goal, field in zip(goals, self._compute(self._grid, goals, costs), strict=True):
                self._keep(goal, costs, field)

    def _keep(self, goal: int, costs: Costs, field: Floats) -> None:
        self._fields[goal, costs] = field
        while len(self._fields) + len(self._stale) > self.capacity and self._forget():
            pass

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

    def is_open(self, cell: int, zone_cost: Mapping[str, float] | None = None) -> bool:
        """Return whether a robot may enter a cell: it is not shut, and not in a zone that is closed to it."""
        return self._can_enter(cell, _costs(zone_cost))

    def _can_enter(self, goal: int, costs: Costs) -> bool:
        forbidden = (name for name, factor in costs if factor == inf)
        return goal not in self._shut and not any(goal in self._cells(name) for name in forbidden)

    def _cells(self, name: str) -> tuple[int, ...]:
        """Return the cells of a zone; none of one that is unknown."""
        zone = self._zones.get(name)
        return () if zone is None else zone.cells

    def _closed(self, grid: GridMap, costs: Costs) -> list[tuple[int, int]]:
        """Return the moves ``(from, to)`` that zones for all robots, or those of some costs, do not allow."""
        own = {name for name, factor in costs if not isfinite(factor)}
        closing = (
            zone
            for name, zone in self._zones.items()
            if zone.closes_moves and (not zone.robots or name in own)
        )
        return [move for zone in closing for move in zone.closed(grid)]

    def _free(self, grid: GridMap, costs: Costs) -> Cells:
        """Return which cells a robot may enter, shape (cells,)."""
        free = np.ones(len(grid), bool)
        free[list(self._shut)] = False
        for name, factor in costs:
            if factor == inf:
                free[[cell for cell in self._cells(name) if cell in grid]] = False
        return free

    def _compute(self, grid: GridMap, goals: Sequence[int], costs: Costs) -> list[Floats]:
        open_goals = [goal for goal in goals if goal in grid and self._can_enter(goal, costs)]
        fields: dict[int, Floats] = {}
        if open_goals:
            graph = self._graphs.get(costs)
            if graph is None:
                graph = self._graphs[costs] = self._graph(grid, costs)
                if len(self._graphs) > MOST_GRAPHS:
                    self._graphs.popitem(last=False)
            self._graphs.move_to_end(costs)
            measured = measure_ways(*graph, np.array(open_goals, np.int32))
            # A copy of each: one that is forgotten must not be kept in memory by the others.
            fields = {goal: field.copy() for goal, field in zip(open_goals, measured, strict=True)}
        return [fields[goal] if goal in fields else np.full(len(grid), inf, np.float32) for goal in goals]

    def _graph(self, grid: GridMap, costs: Costs) -> Graph:
        """Return the graph of ways backwards: an edge from each free cell to the cells around it."""
        cells = np.arange(len(grid), dtype=np.int32).reshape(grid.rows, grid.columns)
        pairs = [(cells[:, 1:], cells[:, :-1]), (cells[1:], cells[:-1])]
        heads = np.concatenate([side.ravel() for a, b in pairs for side in (a, b)])
        tails = np.concatenate([side.ravel() for a, b in pairs for side in (b, a)])
        free = self._free(grid, costs)
        weight = np.full(len(grid), grid.cell_size, np.float64)
        for name, factor in costs:
            if isfinite(factor):
                inside = [cell for cell in self._cells(name) if cell in grid]
                weight[inside] *= max(LEAST_FACTOR, factor)  # else no way would be the shortest
        keep = free[heads]
        if closed := self._closed(grid, costs):
            starts, ends = np.array(closed, np.int64).T
            keep &= ~np.isin(tails.astype(np.int64) * len(grid) + heads, starts * len(grid) + ends)
        heads, tails = heads[keep], tails[keep]
        lengths = (weight[heads] + weight[tails]) / 2
        if self._lanes is not None:
            factors = self._lanes.factors(grid, tails, heads)
            keep = factors > 0
            heads, tails, lengths = heads[keep], tails[keep], (lengths * factors)[keep]
        order = np.argsort(heads, kind="stable")
        heads, tails, lengths = heads[order], tails[order], lengths[order]
        indptr = np.concatenate(([0], np.cumsum(np.bincount(heads, minlength=len(grid)))))
        return indptr.astype(np.int32), tails, lengths


class _Parts:
    """The connected parts of the map for robots that may not enter some more cells than others.

    Args:
        grid: The grid.
        common: Cells that all robots may enter, shape (cells,).
        free: Cells that these robots may enter, shape (cells,).

    Attributes:
        counted: Costs of the distances from which those of these robots are estimated.
    """

    def __init__(self, grid: GridMap, common: Cells, free: Cells) -> None:
        shape = grid.rows, grid.columns
        self.counted: Costs = ()
        self._labels = _label(free.reshape(shape))
        self._common = _label(common.reshape(shape))
        self._all = np.ones(len(grid), bool)
        self._cut: dict[tuple[int, int], Cells | None] = {}

    def cut_off(self, goal: int) -> Cells | None:
        """Return from which cells only these robots have no way to one, shape (cells,); None: from none."""
        place = divmod(goal, self._labels.shape[1])
        if not 0 <= goal < self._labels.size or not self._labels[place]:
            return self._all
        key = int(self._labels[place]), int(self._common[place])
        if key not in self._cut:
            cut = _reached(self._common == key[1]) & ~_reached(self._labels == key[0])
            # Mostly the zones are open floor, and leave ways around them.
            self._cut[key] = cut.ravel() if cut.any() else None
        return self._cut[key]


def _label(free: Cells) -> NDArray[np.int32]:
    """Return a number for each connected part, 0 where robots cannot be, shape (rows, columns)."""
    from scipy.ndimage import label  # long to load, needed only with zones for some robots

    labels: NDArray[np.int32] = label(free)[0]
    return labels


def _reached(part: Cells) -> Cells:
    """Return a part with the cells around it: a robot may leave a cell that it may not enter."""
    wide = part.copy()
    wide[1:] |= part[:-1]
    wide[:-1] |= part[1:]
    wide[:, 1:] |= part[:, :-1]
    wide[:, :-1] |= part[:, 1:]
    return wide


def _rules(zones: Mapping[str, Zone]) -> dict[str, tuple[object, ...]]:
    """Return what of zones makes ways longer or closes them, by name."""
    return {
        name: (zone.cells, *((zone.edges, zone.value, zone.robots) if zone.closes_moves else ()))
        for name, zone in zones.items()
    }


def _costs(zone_cost: Mapping[str, float] | None) -> Costs:
    return tuple(sorted(zone_cost.items())) if zone_cost else ()
