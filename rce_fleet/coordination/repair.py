"""A new path for one robot, between the visits of the others, which keep theirs. Pure.

The search is safe interval path planning (Phillips and Likhachev, "SIPP: Safe Interval Path Planning for
Dynamic Environments", 2011) on the ledger: the steps at which no other robot uses a cell are its safe
intervals. All visits stay in one order of steps, so no robots wait for each other in a circle.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.coordination.robot import Phase

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.ledger import CellLedger
    from rce_fleet.coordination.robot import RobotRecord

_FAR = 1 << 30
_SOON = 8.0
"""A robot waits so many steps for a goal that the others have all passed by; else it drives there before."""
_DWELL = 4.0
"""So many steps it must have in its goal before the next robot is due there."""
_FIELDS = 256
"""Distances to so many goals are kept while the map does not change."""
Interval = tuple[float, float]


class PathRepair:
    """Finds new paths for single robots and enters them into the ledger.

    Args:
        state: The fleet; its ledger and the robots' ``unreachable`` are changed.
    """

    def __init__(self, state: FleetState) -> None:
        self._state = state
        self._version = -1
        self._fields: dict[tuple[int, frozenset[int]], list[int]] = {}

    def replan(self, record: RobotRecord, effort: int) -> bool:
        """Give an active robot a new route beyond its granted cells; its old one may be its beginning.

        A robot without a goal, or with one that cannot be reached, stays where it is unless it is in the way.

        Args:
            record: The robot.
            effort: Places and times to try at most.

        Returns:
            Whether it has what it needs; if not, one plan for all has to be made.
        """
        state, ledger = self._state, self._state.ledger
        robot = record.id
        start = ledger.end_of_grant(robot)
        assert start is not None
        forbidden = state.forbidden(robot)
        goal = record.goal
        is_unreachable = goal is not None and not self._can_reach(start, goal, forbidden)
        self._note_unreachable(record, is_unreachable=is_unreachable)
        if is_unreachable or goal is None:
            return self._stand_aside(record, start, forbidden, effort)
        if goal == start and not ledger.occupied(start, robot):
            ledger.truncate(robot)
            return True
        roads = self._roads(forbidden)
        if self._find(record, goal, roads, self._field(goal, forbidden), effort):
            return True
        if _is_enclosed(start, goal, roads):
            # Only robots that take no part are in its way: a plan for all would find no path either.
            self._note_unreachable(record, is_unreachable=True)
            return self._stand_aside(record, start, forbidden, effort)
        return False

    def _stand_aside(self, record: RobotRecord, start: int, forbidden: frozenset[int], effort: int) -> bool:
        """Let a robot that has nowhere to go stay where its granted cells end, or make room there."""
        state, robot = self._state, record.id
        state.ledger.truncate(robot)
        is_in_the_way = bool(state.ledger.occupied(start, robot) or state.index.hindered_at({start}))
        if not is_in_the_way and start not in forbidden and not state.is_shut(start):
            record.rest = start
            return True
        return self._find(record, None, self._roads(forbidden), None, effort)

    def _note_unreachable(self, record: RobotRecord, *, is_unreachable: bool) -> None:
        if record.unreachable != is_unreachable:
            record.unreachable = is_unreachable
            self._state.touch(record)

    def _find(
        self, record: RobotRecord, goal: int | None, roads: Roads, field: Sequence[int] | None, effort: int
    ) -> bool:
        """Enter a path to a goal, or out of the way, into the ledger; return whether there is one."""
        ledger, robot = self._state.ledger, record.id
        self._cut(robot, roads)
        found = find_path(roads, ledger, robot, goal, field, effort)
        if found is None:
            return False
        keep, path = found
        ledger.truncate(robot, keep=len(ledger.granted(robot)) + keep)
        ledger.insert(robot, path)
        record.rest = ledger.route(robot)[-1] if goal is None else None
        return True

    def _cut(self, robot: str, roads: Roads) -> None:
        """End a robot's route before the first cell that it may not enter."""
        ledger = self._state.ledger
        route, granted = ledger.route(robot), len(ledger.granted(robot))
        for index in range(granted, len(route)):
            if route[index] in roads.shut or (route[index - 1], route[index]) in roads.closed:
                ledger.truncate(robot, keep=index)
                return

    def replan_alone(self, record: RobotRecord) -> None:
        """Give a robot its shortest path, without regard to the others that drive."""
        state, goal = self._state, record.goal
        start = state.ledger.end_of_grant(record.id)
        assert start is not None
        forbidden = state.forbidden(record.id)
        roads = self._roads(forbidden)
        field = [_FAR] * len(roads.neighbours)
        if goal is not None and goal not in roads.shut:
            field = _moves_to(goal, roads.neighbours, roads.shut, roads.closed)
        is_unreachable = goal is not None and field[start] >= _FAR
        self._note_unreachable(record, is_unreachable=is_unreachable)
        if goal is None or is_unreachable or goal == start:
            return
        path, step, cell = [], state.ledger.start_step(record.id), start
        while cell != goal:
            ways = [
                way
                for way in roads.neighbours[cell]
                if way not in roads.shut and (cell, way) not in roads.closed
            ]
            cell = min(ways, key=field.__getitem__)
            step += 1.0
            path.append((cell, step))
        state.ledger.insert(record.id, path)

    def _can_reach(self, start: int, goal: int, forbidden: frozenset[int]) -> bool:
        if self._state.is_shut(goal) or goal in forbidden:
            return False
        return start == goal or self._field(goal, forbidden)[start] < _FAR

    def _roads(self, forbidden: frozenset[int]) -> Roads:
        """Return where a robot may drive."""
        state = self._state
        shut = set(state.blocked) | state.pending | forbidden
        for other in state.robots.values():
            if other.phase is not Phase.ACTIVE:
                shut |= state.ledger.claims(other.id)
        return Roads(
            state.grid.neighbours,
            shut,
            state.zones.closed(state.grid),
            state.zones.costs(),
            frozenset(state.index.goals),
        )

    def _field(self, goal: int, forbidden: frozenset[int]) -> list[int]:
        """Return the number of moves to a goal from each cell, without regard to robots."""
        state = self._state
        if self._version != state.map_version or len(self._fields) >= _FIELDS:
            self._fields.clear()
            self._version = state.map_version
        found = self._fields.get((goal, forbidden))
        if found is None:
            shut = state.blocked | state.pending | forbidden
            closed = state.zones.closed(state.grid)
            found = self._fields[goal, forbidden] = _moves_to(goal, state.grid.neighbours, shut, closed)
        return found


@dataclass(frozen=True, slots=True)
class Roads:
    """Where a robot may drive.

    Attributes:
        neighbours: For every cell the cells beside it that are not walls.
        shut: Cells that it may not enter.
        closed: Moves ``(from, to)`` that it may not make.
        costs: Steps that entering a cell takes, where it is not 1.
        goals: Cells that robots are sent to: none of them steps aside into one.
    """

    neighbours: Sequence[Sequence[int]]
    shut: set[int]
    closed: frozenset[tuple[int, int]]
    costs: Mapping[int, int]
    goals: frozenset[int]


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
        effort: Places and times to try at most.

    Returns:
        How many cells of the old path beyond the granted ones are kept, and ``(cell, step)`` of the cells to
        enter after them; None if there is no path, or it was not found.
    """
    search = _Search(roads, ledger, robot, field)
    before, latest = -1, inf
    for _ in range(effort):
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


def _is_enclosed(start: int, goal: int, roads: Roads) -> bool:
    """Return whether no path leads to a goal, whenever a robot drives."""
    return goal in roads.shut or _moves_to(goal, roads.neighbours, roads.shut, roads.closed)[start] >= _FAR


class _Search:
    """The search's nodes: a cell, the interval in which the robot is there, and the earliest time.

    Attributes:
        cells: Cell of each node.
        untils: When the robot must have left it, excluded.
        times: When the robot enters it at the earliest.
        seeds: So many of the first nodes are the old path, from the last granted cell on.
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
        self._best: dict[tuple[int, float], float] = {}
        old = ledger.horizon(robot)
        for cell, step in old:
            until = min((enters for enters, _ in ledger.occupied(cell, robot) if enters > step), default=inf)
            is_alone = len(old) == 1 and max(step, ledger.clock) + 1.0 < until
            self._add(cell, until, max(step, ledger.clock) if is_alone else step, self._rest(cell), -1)
        self.seeds = len(old)

    def take(self) -> int | None:
        """Return the most promising node that was not reached earlier by another way; None without one."""
        while self._heap:
            _, early, node = heappop(self._heap)
            if -early <= self._best[self.cells[node], self.untils[node]]:
                return node
        return None

    def expand(self, node: int) -> None:
        """Add the nodes that can be reached from one."""
        roads, cell, until, time = self._roads, self.cells[node], self.untils[node], self.times[node]
        for other in roads.neighbours[cell]:
            if other in roads.shut or (cell, other) in roads.closed:
                continue
            rest = self._rest(other)
            if rest >= _FAR:
                continue
            pace: float = roads.costs.get(other, 1)
            if node < self.seeds:
                pace = min(pace, (until - time) / 2)  # It may have to give way at once.
            for after, before in self._known.of(other):
                if after >= until:
                    break
                at = max(time + pace, after + min(0.5, (before - after) / 2) if after > -inf else -inf)
                if at < min(before, until, self._best.get((other, before), inf)):
                    self._add(other, before, at, rest, node)

    def _rest(self, cell: int) -> int:
        return 0 if self._field is None else self._field[cell]

    def _add(self, cell: int, until: float, at: float, rest: int, parent: int) -> None:
        self._best[cell, until] = at
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
        self._known: dict[int, list[Interval]] = {}

    def of(self, cell: int) -> list[Interval]:
        """Return the intervals of a cell in order, as ``(after, before)``, both excluded."""
        found = self._known.get(cell)
        if found is None:
            found, free_from = [], -inf
            for enters, leaves in self._ledger.occupied(cell, self._robot):
                if enters > free_from:
                    found.append((free_from, enters))
                free_from = max(free_from, leaves)
            if free_from < inf:
                found.append((free_from, inf))
            self._known[cell] = found
        return found


def _moves_to(
    goal: int,
    neighbours: Sequence[Sequence[int]],
    shut: set[int] | frozenset[int],
    closed: frozenset[tuple[int, int]],
) -> list[int]:
    """Return the number of moves to a goal, by breadth-first search; cells that are shut can be left."""
    field = [_FAR] * len(neighbours)
    field[goal] = 0
    queue = deque((goal,))
    while queue:
        cell = queue.popleft()
        if cell in shut and cell != goal:
            continue
        moves = field[cell] + 1
        for other in neighbours[cell]:
            if field[other] > moves and (not closed or (other, cell) not in closed):
                field[other] = moves
                queue.append(other)
    return field
