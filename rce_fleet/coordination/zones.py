"""Zones: parts of the map with rules of their own. Pure.

A zone blocks cells or moves, slows robots down, has one direction, has room for a few robots, or costs more.
It has a reason and an author, may expire, and may apply to some robots only. The same id replaces a zone, so
setting it twice is harmless. All zones together have a revision, against lost updates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from math import ceil, inf
from typing import TYPE_CHECKING

from rce_fleet.exceptions import ZoneError
from rce_fleet.limits import LEAST_SPEED, MOST_FACTOR, MOST_ROOM, MOST_SPEED
from rce_fleet.planning.lanes import MOST_COST, NOMINAL_SPEED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.lanes import LaneGraph


MOST_NAMED = 5
"""So many cells are named in an error: a request may have very many."""


class ZoneKind(Enum):
    """What a zone does."""

    BLOCKED = "blocked"
    """Robots may not enter its cells, nor drive its edges."""
    SLOW = "slow"
    """Robots drive at most at its speed, and prefer other ways."""
    ONE_WAY = "one_way"
    """Robots do not drive against its direction."""
    LIMITED = "limited"
    """It has room for a few robots."""
    COST = "cost"
    """Robots prefer other ways."""


class Direction(Enum):
    """Direction of a one-way zone, along the grid's columns or rows: ``(rows, columns)`` of a move."""

    PLUS_X = "+x"
    MINUS_X = "-x"
    PLUS_Y = "+y"
    MINUS_Y = "-y"

    def against(self, columns: int) -> int:
        """Return the difference of cell numbers of a move against the direction."""
        return {"+x": -1, "-x": 1, "+y": -columns, "-y": columns}[self.value]


@dataclass(frozen=True, slots=True)
class Zone:
    """A part of the map with a rule.

    Attributes:
        id: Its name; a zone with the same name replaces it.
        kind: What it does.
        cells: Its cells, ascending.
        edges: Moves ``(from, to)`` that are blocked; of a blocked zone only.
        robots: Robots that it applies to; empty: all.
        speed: Greatest speed in a slow zone, metres per second.
        direction: Of a one-way zone.
        capacity: Robots for which a limited zone has room.
        cost: How much a metre counts in a cost zone.
        reason: Why it was made, for people.
        by: Who made it.
        expires: When it ends, seconds of the planner's clock; infinity: when it is removed.
    """

    id: str
    kind: ZoneKind
    cells: tuple[int, ...] = ()
    edges: tuple[tuple[int, int], ...] = ()
    robots: tuple[str, ...] = ()
    speed: float = 0.0
    direction: Direction | None = None
    capacity: int = 0
    reason: str = ""
    by: str = ""
    expires: float = inf
    cost: float = 0.0

    @property
    def weight(self) -> int:
        """Cost of entering one of its cells; 1: as anywhere else."""
        factor = 1.0
        if self.kind is ZoneKind.SLOW:
            factor = NOMINAL_SPEED / self.speed
        elif self.kind is ZoneKind.COST:
            factor = self.cost
        return _steps(factor)

    def applies_to(self, robot: str) -> bool:
        """Return whether the zone's rule is for this robot."""
        return not self.robots or robot in self.robots

    def check(self, grid: GridMap) -> None:
        """Check that the zone can be on a map.

        Raises:
            ZoneError: It cannot; the text says why.
        """
        where = f"zone {self.id!r}"
        cells = {*self.cells, *(cell for edge in self.edges for cell in edge)}
        outside = sorted(cell for cell in cells if cell not in grid)
        more = f" and {len(outside) - MOST_NAMED} more" if len(outside) > MOST_NAMED else ""
        far = [
            edge for edge in self.edges if edge[0] in grid and edge[1] in grid and not grid.adjacent(*edge)
        ]
        checks = (
            (not self.id, "a zone needs an id"),
            (
                bool(outside),
                f"{where}: cells {outside[:MOST_NAMED]}{more} are not on the map of {len(grid)} cells",
            ),
            (bool(far), f"{where}: cells of edge {far[:1]} are not neighbours"),
            (not self.cells and not self.edges, f"{where} has no cells"),
            (
                bool(self.edges) and self.kind is not ZoneKind.BLOCKED,
                f"{where}: only a blocked zone has edges",
            ),
            (
                self.kind is ZoneKind.SLOW and not LEAST_SPEED <= self.speed <= MOST_SPEED,
                f"{where}: a slow zone needs {LEAST_SPEED} .. {MOST_SPEED:g} m/s, not {self.speed}",
            ),
            (
                self.kind is ZoneKind.ONE_WAY and self.direction is None,
                f"{where}: a one-way zone needs a direction: +x, -x, +y or -y",
            ),
            (
                self.kind is ZoneKind.LIMITED and not 1 <= self.capacity <= MOST_ROOM,
                f"{where}: a limited zone needs a capacity of 1 .. {MOST_ROOM}, not {self.capacity}",
            ),
            (
                self.kind is ZoneKind.COST and not 1 <= self.cost <= MOST_FACTOR,
                f"{where}: in a cost zone a metre counts 1 .. {MOST_FACTOR:g}, not {self.cost}",
            ),
        )
        for is_wrong, text in checks:
            if is_wrong:
                raise ZoneError(text)


class ZoneBook:
    """The zones of a map, and what they and the lanes below them mean for a cell, a move or a robot.

    Args:
        lanes: Lanes that robots have to keep to; None: they drive anywhere.

    Attributes:
        zones: By id.
        lanes: See above.
        revision: Grows with each change; 0 before the first.
        own_costs: How much a metre in zones counts for single robots, in place of what the zones say; by
            robot and id of the zone, which need not exist.
    """

    def __init__(self, lanes: LaneGraph | None = None) -> None:
        self.lanes = lanes
        self._off_lanes: frozenset[tuple[int, int]] | None = None
        self.zones: dict[str, Zone] = {}
        self.revision = 0
        self.own_costs: Mapping[str, Mapping[str, float]] = {}
        self._forget()

    def _forget(self) -> None:
        """Forget what was computed from the zones."""
        self._closed: frozenset[tuple[int, int]] | None = None
        self._costs: dict[tuple[tuple[str, int], ...], dict[int, int]] = {}
        self._costs_of: dict[str, dict[int, int]] = {}
        self._cells: dict[str, frozenset[int]] = {}
        self._blocking: dict[int, Zone] | None = None
        self._forbidden: dict[tuple[str, ...], frozenset[int]] = {}
        self._own_closed: dict[tuple[str, ...], frozenset[tuple[int, int]]] = {}
        self._closing: list[Zone] | None = None
        """Zones that close moves for some robots."""

    # Changes

    def put(self, zones: Iterable[Zone], remove: Iterable[str] = ()) -> tuple[list[Zone], list[Zone]]:
        """Add or replace zones, and remove others; return the zones that are gone, and the new ones."""
        gone = [self.zones.pop(name) for name in sorted(set(remove)) if name in self.zones]
        made = []
        for zone in zones:
            before = self.zones.get(zone.id)
            if before == zone:
                continue
            if before is not None:
                gone.append(before)
            self.zones[zone.id] = zone
            made.append(zone)
        if gone or made:
            self.revision += 1
            self._forget()
        return gone, made

    def set_own_costs(self, costs: Mapping[str, Mapping[str, float]]) -> bool:
        """Replace all own costs of robots, see :attr:`own_costs`; return whether they changed."""
        if costs == self.own_costs:
            return False
        self.own_costs = {robot: dict(factors) for robot, factors in costs.items()}
        self._forget()
        return True

    def expired(self, now: float) -> list[str]:
        """Return the ids of zones that have ended."""
        return sorted(zone.id for zone in self.zones.values() if zone.expires <= now)

    # What they mean

    def of_kind(self, kind: ZoneKind) -> list[Zone]:
        """Return the zones of a kind."""
        return [zone for zone in self.zones.values() if zone.kind is kind]

    def blocks(self, cell: int) -> Zone | None:
        """Return a zone that blocks a cell for all robots."""
        if self._blocking is None:
            self._blocking = {}
            for zone in self.of_kind(ZoneKind.BLOCKED):
                for other in () if zone.robots else zone.cells:
                    self._blocking.setdefault(other, zone)
        return self._blocking.get(cell)

    def cells(self, zone: Zone) -> frozenset[int]:
        """Return the cells of one of the zones as a set."""
        found = self._cells.get(zone.id)
        if found is None:
            found = self._cells[zone.id] = frozenset(zone.cells)
        return found

    def forbidden(self, robot: str) -> frozenset[int]:
        """Return the cells that are blocked for one robot, but not for all."""
        zones = [zone for zone in self.of_kind(ZoneKind.BLOCKED) if zone.robots and zone.applies_to(robot)]
        key = tuple(zone.id for zone in zones)
        found = self._forbidden.get(key)
        if found is None:
            found = self._forbidden[key] = union_of([self.cells(zone) for zone in zones])
        return found

    def closed(self, grid: GridMap) -> frozenset[tuple[int, int]]:
        """Return the moves ``(from, to)`` that no robot may make.

        Args:
            grid: The map, always the same one.
        """
        if self._closed is None:
            if self.lanes is not None and self._off_lanes is None:
                self._off_lanes = self.lanes.closed(grid)
            zones = [zone for zone in self.zones.values() if not zone.robots]
            self._closed = (self._off_lanes or frozenset()) | _closed_by(zones, grid)
        return self._closed

    def closed_for(self, robot: str, grid: GridMap) -> frozenset[tuple[int, int]]:
        """Return the moves ``(from, to)`` that one robot may not make, but others may.

        Args:
            robot: The robot. Robots with the same zones share one object.
            grid: The map, always the same one.
        """
        if self._closing is None:
            zones = self.zones.values()
            self._closing = [zone for zone in zones if zone.robots and (zone.edges or zone.direction)]
        own = [zone for zone in self._closing if zone.applies_to(robot)]
        key = tuple(zone.id for zone in own)
        found = self._own_closed.get(key)
        if found is None:
            found = self._own_closed[key] = _closed_by(own, grid)
        return found

    @property
    def move_costs(self) -> Mapping[tuple[int, int], int]:
        """The costs of moves ``(from, to)`` on lanes that do not cost 1, for all robots."""
        return {} if self.lanes is None else self.lanes.costs

    def costs(self) -> Mapping[int, int]:
        """Return the cost of entering cells of slow zones and cost zones for all robots; others cost 1."""
        return self._costs_in((zone, zone.weight) for zone in self.zones.values() if not zone.robots)

    def costs_of(self, robot: str) -> Mapping[int, int]:
        """Return the cost of entering cells for one robot.

        Robots with the same costs share one object; it is that of :meth:`costs` for those without own ones.
        """
        found = self._costs_of.get(robot)
        if found is None:
            own = self.own_costs.get(robot, {})
            weighted = (
                (zone, _steps(own[zone.id]) if zone.id in own else zone.weight)
                for zone in self.zones.values()
                if zone.id in own or zone.applies_to(robot)
            )
            found = self._costs_of[robot] = self._costs_in(weighted)
        return found

    def _costs_in(self, weighted: Iterable[tuple[Zone, int]]) -> dict[int, int]:
        """Return the cost of entering the cells of zones, given with their weights."""
        costly = [(zone, weight) for zone, weight in weighted if weight > 1]
        key = tuple((zone.id, weight) for zone, weight in costly)
        found = self._costs.get(key)
        if found is None:
            found = self._costs[key] = {}
            for zone, weight in costly:
                for cell in zone.cells:
                    found[cell] = max(found.get(cell, 1), weight)
        return found

    def speed_limit(self, robot: str, cells: Sequence[int]) -> float:
        """Return the greatest speed of a robot on its way over cells, m/s; infinity without a limit."""
        inside = set(cells)
        on_lanes = inf if self.lanes is None else self.lanes.speed_limit(cells)
        limits = [
            zone.speed
            for zone in self.of_kind(ZoneKind.SLOW)
            if zone.applies_to(robot) and not inside.isdisjoint(zone.cells)
        ]
        return min([on_lanes, *limits])

    def full(self, robot: str, users: Callable[[Zone], set[str]]) -> frozenset[int]:
        """Return the cells of limited zones that have no room for a robot.

        Args:
            robot: The robot.
            users: Returns the robots that are in a zone, or have a path into it.
        """
        found = []
        for zone in self.of_kind(ZoneKind.LIMITED):
            if zone.applies_to(robot):
                others = {other for other in users(zone) if zone.applies_to(other)} - {robot}
                if len(others) >= zone.capacity:
                    found.append(self.cells(zone))
        return union_of(found)


def _steps(factor: float) -> int:
    """Return the cost of entering a cell where a metre counts so much."""
    return max(ceil(min(factor, MOST_COST)), 1)


def _closed_by(zones: Iterable[Zone], grid: GridMap) -> frozenset[tuple[int, int]]:
    """Return the moves between cells of a map that some zones do not allow."""
    closed: set[tuple[int, int]] = set()
    for zone in zones:
        closed |= grid.adjacent_moves(zone.edges)
        if zone.direction is not None and zone.kind is ZoneKind.ONE_WAY:
            closed |= grid.moves_by(zone.direction.against(grid.columns), zone.cells)
    return frozenset(closed)


def union_of(sets: Sequence[frozenset[int]]) -> frozenset[int]:
    """Return a union, without a copy if only one set has members."""
    parts = [part for part in sets if part]
    return parts[0] if len(parts) == 1 else frozenset().union(*parts)


def carried_zones(zones: Iterable[Zone], carry: Callable[[Iterable[int]], set[int]]) -> list[Zone]:
    """Return zones on another grid: their cells are those that overlap the cells before; edges are dropped.

    Args:
        zones: The zones until now.
        carry: Returns the new cells that overlap old ones.
    """
    moved = [replace(zone, cells=tuple(sorted(carry(zone.cells))), edges=()) for zone in zones]
    return [zone for zone in moved if zone.cells]
