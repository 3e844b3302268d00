"""The search for one robot's path between the visits of the others. Pure.

It is safe interval path planning (Phillips and Likhachev, "SIPP: Safe Interval Path Planning for
Dynamic Environments", 2011) on the ledger: the steps at which no other robot uses a cell are its safe
intervals. All visits stay in one order of steps, so no robots wait for each other in a circle.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.planning.motion import direction_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rce_fleet.coordination.ledger import CellLedger

FAR = 1 << 30
"""A number of moves that means that there is no path."""
_SOON = 8.0
"""A robot waits so many steps for a goal that the others have all passed by; else it drives there before."""
_DWELL = 4.0
"""So many steps it must have in its goal before the next robot is due there."""
Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Turns:
    """What turns cost a robot.

    Attributes:
        facing: Its heading at the end of its granted cells, see :mod:`rce_fleet.planning.motion`.
        columns: Columns of the grid.
        steps: Steps of turning from each heading to each direction.
    """

    facing: int
    columns: int
    steps: Sequence[Sequence[float]]


@dataclass(frozen=True, slots=True)
class Roads:
    """Where a robot may drive.

    Attributes:
        neighbours: For every cell the cells beside it that are not walls.
        shut: Cells that it may not enter.
        closed: Moves ``(from, to)`` that it may not make.
        costs: Steps that entering a cell takes, where it is not 1.
        goals: Cells that robots are sent to: none of them steps aside into one.
        move_costs: Steps that moves ``(from, to)`` take, where it is not 1.
        turns: What its turns cost; None: nothing.
    """

    neighbours: Sequence[Sequence[int]]
    shut: set[int]
    closed: frozenset[tuple[int, int]]
    costs: Mapping[int, int]
    goals: frozenset[int]
    move_costs: Mapping[tuple[int, int], int]
    turns: Turns | None = None

    def cost(self, start: int, end: int) -> int:
        """Return how many steps a move takes."""
        steps = self.costs.get(end, 1)
        return max(steps, self.move_costs.get((start, end), 1)) if self.move_costs else steps


def find_path(
    roads: Roads, ledger: CellLedger, robot: str, goal: int | None, field: Sequence[int] | None, effort: int
) -> tuple[int, list[tuple[int, float]]] | None:
    """Return a path from the end of a robot's granted cells, between the visits of the other robots.

    The path may begin with the robot's old one: robots that follow each other closely leave no other room.

    A robot may reach its goal before others pass through this cell, if it would have to wait long for them:
    they wait until it has another goal (see :mod:`rce_fleet.coordination.starvation`).

    Args:
        roads: Where it may drive.
        ledger: The visits of all robots.
        robot: The robot; it may drive its whole route.
        goal: Where the path ends; None: in any cell where it hinders no other robot.
        field: Moves to the goal from each cell; None without a goal.
        effort: Places and times to try at most: intervals of cells that are looked at.

    Returns:
        How many cells of the old path beyond the granted ones are kept, and ``(cell, step)`` of the cells to
        enter after them; None if there is no path, or it was not found.
    """
    search = _Search(roads, ledger, robot, field)
    before, latest = -1, inf
    while search.tried < effort:
        node = search.take()
        cell = -1 if node is None else search.cells[node]
        if node is None or (field is not None and search.times[node] + field[cell] > latest):
            break
        room = search.untils[node] - search.times[node]
        if before < 0 and cell == goal and cell != search.cells[0] and _DWELL <= room < inf:
            before, latest = node, search.times[node] + _SOON
        is_aside = goal is None and node >= search.seeds and cell not in roads.goals
        if search.untils[node] == inf and (cell == goal or is_aside):
            return search.trace(node)
        search.expand(node)
    return search.trace(before) if before >= 0 else None


def is_enclosed(start: int, goal: int, roads: Roads) -> bool:
    """Return whether no path leads to a goal, whenever a robot drives."""
    if goal in roads.shut:
        return True
    return moves_to(goal, roads.neighbours, roads.shut, roads.closed, start)[start] >= FAR


class _Search:
    """The search's nodes: a cell, the interval in which the robot is there, and the earliest time.

    Attributes:
        cells: Cell of each node.
        untils: When the robot must have left it, excluded.
        times: When the robot enters it at the earliest.
        seeds: So many of the first nodes are the old path, from the last granted cell on.
        tried: Intervals of cells that were looked at so far.
    """

    def __init__(self, roads: Roads, ledger: CellLedger, robot: str, field: Sequence[int] | None) -> None:
        self._roads = roads
        self._known = _Intervals(ledger, robot)
        self._field = field
        self.cells: list[int] = []
        self.untils: list[float] = []
        self._parents: list[int] = []
        self.times: list[float] = []
        self._heap: list[tuple[float, float, int]] = []
        self._headings: list[int] = []
        self._best: dict[tuple[int, float, int], float] = {}
        old = ledger.horizon(robot)
        self.tried = len(old)
        before, heading = -1, 0 if roads.turns is None else roads.turns.facing
        for cell, step in old:
            heading = heading if before < 0 else self._heading(before, cell)
            before = cell
            until = min((enters for enters, _ in ledger.occupied(cell, robot) if enters > step), default=inf)
            is_alone = len(old) == 1 and max(step, ledger.clock) + 1.0 < until
            at = max(step, ledger.clock) if is_alone else step
            self._add(cell, until, heading, at, self._rest(cell), -1)
        self.seeds = len(old)

    def take(self) -> int | None:
        """Return the most promising node that was not reached earlier by another way; None without one."""
        while self._heap:
            _, early, node = heappop(self._heap)
            if -early <= self._best[self.cells[node], self.untils[node], self._headings[node]]:
                return node
        return None

    def expand(self, node: int) -> None:
        """Add the nodes that can be reached from one."""
        self.tried += 1
        roads, cell, until, time = self._roads, self.cells[node], self.untils[node], self.times[node]
        for other in roads.neighbours[cell]:
            if other in roads.shut or (cell, other) in roads.closed:
                continue
            rest = self._rest(other)
            if rest >= FAR:
                continue
            pace: float = roads.cost(cell, other) if roads.move_costs else roads.costs.get(other, 1)
            heading = self._heading(cell, other)
            if roads.turns is not None:
                pace += roads.turns.steps[self._headings[node]][heading]
            if node < self.seeds:
                pace = min(pace, (until - time) / 2)  # It may have to give way at once.
            for after, before in self._known.from_step(other, time):
                self.tried += 1
                if after >= until:
                    break
                at = max(time + pace, after + min(0.5, (before - after) / 2) if after > -inf else -inf)
                if at < min(before, until) and not self._is_reached(other, before, heading, at):
                    self._add(other, before, heading, at, rest, node)

    def _heading(self, cell: int, other: int) -> int:
        """Return the direction of a move; always the same one where turns cost nothing."""
        turns = self._roads.turns
        return 0 if turns is None else direction_of(other - cell, turns.columns)

    def _is_reached(self, cell: int, until: float, heading: int, at: float) -> bool:
        """Return whether a robot can be in a cell, and have turned to a heading, as early by another way."""
        turns = self._roads.turns
        if turns is None:
            return self._best.get((cell, until, heading), inf) <= at
        return any(
            self._best.get((cell, until, other), inf) + row[heading] <= at
            for other, row in enumerate(turns.steps)
        )

    def _rest(self, cell: int) -> int:
        return 0 if self._field is None else self._field[cell]

    def _add(self, cell: int, until: float, heading: int, at: float, rest: int, parent: int) -> None:
        self._best[cell, until, heading] = at
        self._headings.append(heading)
        heappush(self._heap, (at + rest, -at, len(self.cells)))
        self.cells.append(cell)
        self.untils.append(until)
        self._parents.append(parent)
        self.times.append(at)

    def trace(self, node: int) -> tuple[int, list[tuple[int, float]]]:
        """Return how many cells of the old path lead to a node, and cells and times from there."""
        path = []
        while self._parents[node] >= 0:
            path.append((self.cells[node], self.times[node]))
            node = self._parents[node]
        return node, path[::-1]


class _Intervals:
    """The safe intervals of cells: between which steps no other robot uses them."""

    def __init__(self, ledger: CellLedger, robot: str) -> None:
        self._ledger = ledger
        self._robot = robot
        self._known: dict[int, tuple[list[Interval], list[float]]] = {}

    def from_step(self, cell: int, step: float) -> Iterator[Interval]:
        """Yield the intervals of a cell that end after a step, as ``(after, before)``, both excluded."""
        intervals, ends = self._known.get(cell) or self._look_at(cell)
        return islice(intervals, bisect_right(ends, step), None)

    def _look_at(self, cell: int) -> tuple[list[Interval], list[float]]:
        """Return the intervals of a cell in order, and the ends of all."""
        found, free_from = [], -inf
        for enters, leaves in self._ledger.occupied(cell, self._robot):
            if enters > free_from:
                found.append((free_from, enters))
            free_from = max(free_from, leaves)
        if free_from < inf:
            found.append((free_from, inf))
        known = self._known[cell] = found, [before for _, before in found]
        return known


def moves_to(
    goal: int,
    neighbours: Sequence[Sequence[int]],
    shut: set[int] | frozenset[int],
    closed: frozenset[tuple[int, int]],
    start: int = -1,
) -> list[int]:
    """Return the number of moves to a goal, by breadth-first search; cells that are shut can be left.

    With a cell ``start``, only this one's and those of nearer cells count.
    """
    field = [FAR] * len(neighbours)
    field[goal] = 0
    queue = deque((goal,))
    while queue:
        cell = queue.popleft()
        if cell == start:
            break
        if cell in shut and cell != goal:
            continue
        moves = field[cell] + 1
        for other in neighbours[cell]:
            if field[other] > moves and (not closed or (other, cell) not in closed):
                field[other] = moves
                queue.append(other)
    return field


def costs_to(goal: int, roads: Roads) -> list[int]:
    """Return the cost of the cheapest way to a goal from each cell, without regard to robots."""
    if not roads.costs and not roads.move_costs:
        return moves_to(goal, roads.neighbours, roads.shut, roads.closed)
    least = [FAR] * len(roads.neighbours)
    least[goal] = 0
    heap = [(0, goal)]
    while heap:
        cost, cell = heappop(heap)
        if cost > least[cell] or (cell in roads.shut and cell != goal):
            continue
        for other in roads.neighbours[cell]:
            through = cost + roads.cost(other, cell)
            if through < least[other] and (other, cell) not in roads.closed:
                least[other] = through
                heappush(heap, (through, other))
    return least
