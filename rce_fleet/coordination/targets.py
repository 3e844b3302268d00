"""The target of each robot in a plan: its goal, or a cell out of the way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.planning.grid import GridMap


@dataclass(frozen=True, slots=True)
class Targets:
    """One target a robot, all different.

    Attributes:
        cells: Target of every robot.
        unreachable: Robots whose goal cannot be reached; their target is a place to wait.
    """

    cells: dict[str, int]
    unreachable: frozenset[str]


def assign_targets(
    grid: GridMap,
    starts: Mapping[str, int],
    goals: Mapping[str, int],
    rests: Mapping[str, int],
    *,
    closed: frozenset[tuple[int, int]] = frozenset(),
    forbidden: Mapping[str, frozenset[int]] | None = None,
    own_closed: Mapping[str, frozenset[tuple[int, int]]] | None = None,
) -> Targets:
    """Give every robot a target.

    Robots with a goal that can be reached get it. The others get their place of rest, or if that is blocked
    or another robot's target, the nearest free cell that is not.

    Args:
        grid: The map. Robots may stand in blocked cells; no robot can enter one.
        starts: Cells of the robots.
        goals: Goals of some robots, all different.
        rests: Cells where robots without a goal rest; the start by default.
        closed: Moves ``(from, to)`` that no robot may make.
        forbidden: Cells that some robots may not enter.
        own_closed: Moves that some robots may not make, beside ``closed``.
    """
    cells: dict[str, int] = {}
    unreachable = set()
    reach = _Reach(grid, closed)
    barred, shut = forbidden or {}, own_closed or {}
    for robot, goal in goals.items():
        own = barred.get(robot, frozenset())
        within = reach.of(starts[robot], own, shut.get(robot, frozenset()))
        if goal not in grid.blocked and goal not in own and goal in within:
            cells[robot] = goal
        else:
            unreachable.add(robot)
    taken = set(cells.values())
    waiting = deque(robot for robot in starts if robot not in cells)
    while waiting:
        robot = waiting.popleft()
        start, own = starts[robot], barred.get(robot, frozenset())
        rest = start if robot in unreachable else rests.get(robot, start)
        within = reach.of(start, own, shut.get(robot, frozenset())) - own
        cell = _refuge(grid, within, rest, taken)
        if cell is None:  # it cannot leave, so another robot that was to come here cannot
            cell = start
            for other in [one for one, target in cells.items() if target == start]:
                del cells[other]
                waiting.append(other)
                if other in goals:
                    unreachable.add(other)
        cells[robot] = cell
        taken.add(cell)
    return Targets(cells, frozenset(unreachable))


class _Reach:
    """Cells that can be reached from a start; cells that can be reached from each other are searched once."""

    def __init__(self, grid: GridMap, closed: frozenset[tuple[int, int]]) -> None:
        self._grid = grid
        self._closed = closed
        self._known: dict[int, set[int]] = {}

    def of(self, start: int, forbidden: frozenset[int], own_closed: frozenset[tuple[int, int]]) -> set[int]:
        """Return the cells that can be reached from ``start``, with ``start`` itself."""
        if forbidden or own_closed:
            return self._search(start, forbidden, self._closed | own_closed if own_closed else self._closed)
        found = self._known.get(start)
        if found is None and not self._closed:
            found = self._grid.reachable(start)
            if start not in self._grid.blocked:
                self._known.update(dict.fromkeys(found, found))
        elif found is None:
            found = self._search(start, forbidden, self._closed)
            alike = found & self._search_back(start)
            self._known.update(dict.fromkeys(alike, found))
        return found

    def _search(self, start: int, forbidden: frozenset[int], closed: frozenset[tuple[int, int]]) -> set[int]:
        seen = {start}
        queue = deque(seen)
        while queue:
            cell = queue.popleft()
            for other in self._grid.neighbours[cell]:
                if other not in seen and other not in forbidden and (cell, other) not in closed:
                    seen.add(other)
                    queue.append(other)
        return seen

    def _search_back(self, end: int) -> set[int]:
        """Return the cells from which ``end`` can be reached, with ``end`` itself."""
        grid, closed, seen = self._grid, self._closed, {end}
        queue = deque(seen)
        while queue:
            cell = queue.popleft()
            if cell in grid.blocked:
                continue  # no move enters it
            for other in grid.around(cell):
                if other not in seen and (other, cell) not in closed:
                    seen.add(other)
                    queue.append(other)
        return seen


def _refuge(grid: GridMap, within: set[int], rest: int, taken: set[int]) -> int | None:
    """Return the cell of rest, or the nearest free cell that can be reached and is not a target; or None."""
    seen = {rest}
    queue = deque(seen)
    while queue:
        cell = queue.popleft()
        if cell in within and cell not in taken and cell not in grid.blocked:
            return cell
        for other in grid.around(cell):
            if other not in seen:
                seen.add(other)
                queue.append(other)
    return None
