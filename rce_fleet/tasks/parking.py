"""Where idle robots wait without being in the way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping
    from collections.abc import Set as AbstractSet

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.tasks.facts import FleetFacts, RobotFacts
    from rce_fleet.tasks.idle_ways import IdleWays
    from rce_fleet.tasks.records import Zone

_RING = ((-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1))
_LOOK_AT_MOST = 2000
"""Cells that are looked at for a place to wait."""
_SEARCHES = 4
"""Robots for which such a place is searched in one step: where there is none, each takes milliseconds."""
_SEARCH_AGAIN_S = 10.0
"""After so long it is searched again for a robot that found none."""


@dataclass(frozen=True, slots=True)
class ParkingCells:
    """Where idle robots can wait, and where they are in the way.

    Attributes:
        parking: The parking places; empty: there are none.
        used: Cells of open tasks, chargers, and full zones with either.
        taken: Cells to which robots go now for tasks, or where they act.
        own_zones: Zones that are blocked for single robots.
        barring: Cells in which robots rest on the paths of others.
    """

    parking: AbstractSet[int]
    used: AbstractSet[int]
    taken: AbstractSet[int]
    own_zones: Collection[Zone] = ()
    barring: AbstractSet[int] = frozenset()

    def is_in_way(self, cell: int) -> bool:
        """Return whether an idle robot in a cell has to go elsewhere."""
        if cell in self.taken or cell in self.barring:
            return True
        return cell not in self.parking if self.parking else cell in self.used

    def closed_to(self, robot: str) -> set[int]:
        """Return the cells that only zones of its own close to a robot."""
        return {cell for zone in self.own_zones if zone.applies_to(robot) for cell in zone.cells}


class Parking:
    """The cells where idle robots wait: parking places, or cells where they hinder no other robot.

    Args:
        ways: Which cells robots can reach.
        after: An idle robot goes out of the way after this time, seconds.

    Attributes:
        cells: Where each robot goes or waits, by name.
    """

    def __init__(self, ways: IdleWays, after: float) -> None:
        self._ways = ways
        self._after = after
        self.cells: dict[str, int] = {}
        self._idle_since: dict[str, float] = {}
        self._search_at: dict[str, float] = {}
        """When a place is searched again for a robot that found none."""
        self._refused: dict[str, set[int]] = {}
        """Places that were found for a robot and that it cannot reach."""

    def update(
        self,
        now: float,
        idle: Mapping[str, RobotFacts],
        charging: Collection[str],
        facts: FleetFacts,
        cells: ParkingCells,
    ) -> None:
        """Send idle robots out of the way, some time after they have become idle.

        Args:
            now: Seconds since 1970.
            idle: Robots without a task that can be sent somewhere, by name.
            charging: Robots that charge.
            facts: All robots, and the map.
            cells: Where they can wait, and where they are in the way.
        """
        self._idle_since = {name: self._idle_since.get(name, now) for name in idle}
        self._search_at = {name: at for name, at in self._search_at.items() if name in idle and now < at}
        self.cells = {
            name: cell
            for name, cell in self.cells.items()
            if name in idle
            and name not in charging
            and not cells.is_in_way(cell)
            and not self._ways.is_closed(idle[name], cell)
        }
        moves = [
            robot
            for robot in idle.values()
            if robot.id not in charging
            and robot.id not in self.cells
            and now - self._idle_since[robot.id] >= self._after
            and robot.cell is not None
            and cells.is_in_way(robot.cell)
        ]
        moving = {robot.id for robot in moves}
        self._refused = {name: found for name, found in self._refused.items() if name in moving}
        if not moves or facts.grid is None:
            return
        avoided = {robot.cell for robot in facts.robots.values() if robot.cell is not None}
        avoided.update(self.cells.values(), cells.taken)
        crowded = cells.used | cells.barring
        free = [cell for cell in cells.parking if cell not in avoided and cell not in cells.barring]
        avoided |= crowded
        searches = 0
        for robot in moves:
            place = self._ways.nearest(robot, free) if free else None
            may_search = searches < _SEARCHES and robot.id not in self._search_at
            if place is None and may_search and robot.cell is not None and robot.cell in crowded:
                searches += 1
                refused = self._refused.setdefault(robot.id, set())
                closed = cells.closed_to(robot.id)
                place = place_to_wait(facts.grid, facts.shut, robot.cell, avoided | refused, closed)
                if place is None:
                    self._search_at[robot.id] = now + _SEARCH_AGAIN_S
                    refused.clear()
                elif self._ways.nearest(robot, (place,)) is None:
                    refused.add(place)  # the next step finds another one
                    place = None
            if place is None:
                continue
            self.cells[robot.id] = place
            avoided.add(place)
            if place in free:
                free.remove(place)


def full_zones(zones: Iterable[Zone], facts: FleetFacts, used: AbstractSet[int]) -> set[int]:
    """Return the cells of limited zones without room in which robots are needed: an idle one bars others.

    Args:
        zones: All zones.
        facts: The robots.
        used: Cells to which robots may have to go.
    """
    found: set[int] = set()
    for zone in zones:
        if zone.kind == "limited" and zone.value is not None and not used.isdisjoint(zone.cells):
            cells = frozenset(zone.cells)
            inside = [robot for robot in facts.robots.values() if robot.cell in cells]
            if sum(zone.applies_to(robot.id) for robot in inside) >= zone.value:
                found |= cells
    return found


def keeps_clear(grid: GridMap, shut: Collection[int], cell: int) -> bool:
    """Return whether others get around a robot that waits in a cell.

    The free cells beside it must be connected over the eight cells around it: it is not in a corridor.
    """
    row, column = grid.place(cell)
    ring = []
    for down, right in _RING:
        inside = 0 <= row + down < grid.rows and 0 <= column + right < grid.columns
        ring.append(inside and grid.cell(row + down, column + right) not in shut)
    sides = [index for index in (1, 3, 5, 7) if ring[index]]
    if len(sides) <= 1:
        return True
    gaps = sum(ring[index] and not ring[index - 1] for index in range(len(ring)))
    lone_corners = sum(
        ring[index] and not ring[index - 1] and not ring[(index + 1) % len(ring)] for index in (0, 2, 4, 6)
    )
    return gaps - lone_corners <= 1


def place_to_wait(
    grid: GridMap,
    shut: Collection[int],
    start: int,
    avoided: Collection[int],
    closed: Collection[int] = (),
) -> int | None:
    """Return the nearest cell where a robot hinders no other one; None if there is none near.

    Args:
        grid: The map.
        shut: Cells that no robot can enter.
        start: The robot's cell.
        avoided: Cells that tasks, chargers or other robots use.
        closed: More cells that this robot cannot enter.
    """
    seen, queue = {start}, deque([start])
    while queue and len(seen) < _LOOK_AT_MOST:
        cell = queue.popleft()
        if cell not in avoided and cell not in shut and keeps_clear(grid, shut, cell):
            return cell
        for other in grid.around(cell):
            if other not in seen and other not in shut and other not in closed:
                seen.add(other)
                queue.append(other)
    return None
