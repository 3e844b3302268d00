"""Cells that people, zones or robots' sensors block and free."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import hypot, inf
from typing import TYPE_CHECKING

from rce_fleet.coordination.cell_blocks import CellBlock, ended, renewed
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    CellsIgnored,
    CostsSet,
    ObstacleGone,
    ObstacleSeen,
    Reply,
    ZonesSet,
)
from rce_fleet.coordination.localization import fault_of_place
from rce_fleet.coordination.refusals import describe_zone, refuse_block
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.zones import ZoneKind
from rce_fleet.exceptions import ZoneError
from rce_fleet.limits import LEAST_FACTOR, MOST_FACTOR, MOST_ZONES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.coordination.dispatcher import Dispatcher
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord
    from rce_fleet.coordination.zones import Zone


DOUBTFUL_S = 30.0
"""Seconds: what a robot reported in this time before it was found to be lost, it may have seen elsewhere."""


class CellBlocking:
    """Blocks and frees cells, and stops the robots concerned.

    A cell that only sensors found blocked is freed when a sensor sees that nothing is there any more; one
    that a person blocked is freed by a person only, or when its time has come.

    Args:
        state: The fleet's state.
        dispatcher: Stops robots and makes new plans.
    """

    def __init__(self, state: FleetState, dispatcher: Dispatcher) -> None:
        self._state = state
        self._dispatcher = dispatcher
        self._witnesses: dict[int, tuple[str, float]] = {}
        """Which robot reported a cell as blocked last, and when."""
        self._next_end = 0.0
        """No block of a single cell ends earlier."""

    # What robots see

    def take_obstacle(self, event: ObstacleSeen) -> None:
        """Block the cells that a robot found blocked, if it can see them from where it is."""
        state = self._state
        for cell in self._believable(event):
            owner = state.ledger.owner(cell)
            standing = cell in state.ledger.route(event.robot)[:1]
            # In cells of other robots the sensor has seen these robots.
            if owner not in (None, event.robot) or standing:
                continue
            if not state.is_shut(cell):
                self._shut(cell)
                state.put_block(cell, CellBlock(event.robot, self._dispatcher.now, sensed=True))
                self._next_end = 0.0
            self._witnesses[cell] = event.robot, self._dispatcher.now

    def free_latest_of(self, robot: str) -> None:
        """Free what a robot reported of late, and no other one since: it was not where its poses said."""
        since = self._dispatcher.now - DOUBTFUL_S
        found = []
        for cell in sorted(self._state.sensed):
            witness, at = self._witnesses.get(cell, ("", 0.0))
            if witness == robot and at >= since:
                found.append(cell)
        self._free_sensed(found)

    def take_gone(self, event: ObstacleGone) -> None:
        """Free those of the cells that sensors found blocked, if the robot can see them from where it is."""
        self._free_sensed(self._believable(event))

    def _believable(self, event: ObstacleSeen | ObstacleGone) -> list[int]:
        """Return the cells of a report that are on the grid and that its robot can see.

        A robot that is not where its pose says compares its scan with other walls.
        """
        state, settings = self._state, self._dispatcher.settings
        record = state.robots.get(event.robot)
        fault = fault_of_place(record, settings)
        cells = [cell for cell in event.cells if cell in state.grid]
        if record is None or fault:
            self._dispatcher.out.append(CellsIgnored(event.robot, fault))
            return []
        reach = settings.obstacle_reach + state.grid.cell_size
        near = []
        for cell in cells:
            x, y = state.grid.centre(cell)
            if hypot(x - record.x, y - record.y) <= reach:
                near.append(cell)
        if len(near) < len(cells):
            far = min(set(cells).difference(near))
            reason = f"cell {far} is farther from it than {settings.obstacle_reach:g} m (obstacle_reach)"
            self._dispatcher.out.append(CellsIgnored(event.robot, reason))
        return near

    def take_robot(self, cell: int) -> None:
        """Free a cell that sensors found blocked and that a robot is in: they saw that robot."""
        self._free_sensed([cell])

    def _free_sensed(self, cells: Iterable[int]) -> None:
        """Free those of the cells that only sensors blocked, together: each time looks at all robots."""
        seen = [cell for cell in dict.fromkeys(cells) if cell in self._state.sensed]
        for cell in seen:
            self._state.drop_block(cell)
        self._release(seen)

    # Requests

    def block_cell(self, event: CellBlocked) -> Reply:
        """Block a cell; a robot that is in it leaves it first."""
        cell = event.cell
        refusal = refuse_block(self._state, cell)
        if refusal:
            return Reply(False, refusal)
        self._shut(cell)
        now = self._dispatcher.now
        since = now if event.since is None else min(event.since, now)
        made = CellBlock(event.by, since, event.reason, event.expires)
        self._state.put_block(cell, renewed(self._state.requested.get(cell), made))
        self._next_end = min(self._next_end, event.expires)
        owner = self._state.ledger.owner(cell)
        if owner is None:
            return Reply(True, f"cell {cell} is blocked")
        return Reply(True, f"cell {cell} will be blocked when {owner} has left it")

    def free_cell(self, event: CellFreed) -> Reply:
        """Free a cell, regardless of who blocked it; a zone that blocks it has to be removed instead."""
        cell = event.cell
        refusal = refuse_block(self._state, cell)
        if refusal:
            return Reply(False, refusal)
        zone = self._state.zones.blocks(cell)
        if zone is not None:
            return Reply(False, f"cell {cell} is blocked by {describe_zone(zone)}: remove the zone")
        if not self._state.has_reason(cell):
            return Reply(True, f"cell {cell} is not blocked")
        self._state.drop_block(cell)
        self._release([cell])
        return Reply(True, f"cell {cell} is free")

    def set_zones(self, event: ZonesSet) -> Reply:
        """Make, replace and remove zones."""
        book = self._state.zones
        if event.revision is not None and event.revision != book.revision:
            return Reply(
                False,
                f"the zones have revision {book.revision}, not {event.revision}: read them and try again",
            )
        names = [zone.id for zone in event.zones]
        if len(set(names)) != len(names):
            return Reply(False, f"zones {sorted(names)} do not all have different ids")
        try:
            for zone in event.zones:
                zone.check(self._state.grid)
        except ZoneError as error:
            return Reply(False, str(error))
        remove = set(event.remove) | (book.zones.keys() - set(names) if event.replace else set())
        count = len((book.zones.keys() - remove).union(names))
        if count > max(MOST_ZONES, len(book.zones)):
            return Reply(False, f"there can be {MOST_ZONES} zones, not {count}: remove some")
        made = self._change_zones(event.zones, remove)
        return Reply(True, f"{made} zones changed; their revision is {book.revision}")

    def set_costs(self, event: CostsSet) -> Reply:
        """Set what metres in zones count for single robots; paths that are planned from now on follow."""
        for robot, costs in event.costs.items():
            for zone, factor in costs.items():
                if not LEAST_FACTOR <= factor <= MOST_FACTOR:
                    limits = f"{LEAST_FACTOR:g} .. {MOST_FACTOR:g}"
                    return Reply(False, f"a metre in zone {zone!r} counts {limits} for {robot}, not {factor}")
        if self._state.zones.set_own_costs(event.costs):
            self._state.map_version += 1
        return Reply(True, f"{len(event.costs)} robots have costs of their own in zones")

    def end_expired(self, now: float) -> None:
        """Remove the zones and the blocks of cells that have ended."""
        expired = self._state.zones.expired(now)
        if expired:
            self._change_zones((), expired)
        if now >= self._next_end:
            self._end_blocks(now)

    def _end_blocks(self, now: float) -> None:
        """End the blocks of cells whose time has come, and note when the next one ends."""
        state = self._state
        cells = [*ended(state.requested, now), *ended(self._sensed_blocks(), now)]
        for cell in cells:
            state.drop_block(cell)
        self._release(cells)
        if not state.blocked.isdisjoint(cells):
            # A zone keeps some of them blocked; the list of requested cells changes all the same.
            self._dispatcher.out.append(BlockedChanged(tuple(sorted(state.blocked))))
        left = [*state.requested.values(), *self._sensed_blocks().values()]
        self._next_end = min((block.expires for block in left), default=inf)

    def _sensed_blocks(self) -> dict[int, CellBlock]:
        """Return the blocks of sensed cells with their ends, counted from the newest report of a robot."""
        lifetime = self._dispatcher.settings.sensed_lifetime
        if not lifetime:
            return {}
        return {
            cell: replace(block, expires=self._witnesses.get(cell, ("", block.since))[1] + lifetime)
            for cell, block in self._state.sensed.items()
        }

    # Zones

    def _change_zones(self, zones: Iterable[Zone], remove: Iterable[str]) -> int:
        """Change zones and what follows from them; return how many changed."""
        state = self._state
        gone, made = state.zones.put(zones, remove)
        if not gone and not made:
            return 0
        state.map_version += 1
        self._release(cell for zone in gone for cell in zone.cells if state.is_shut(cell))
        for zone in made:
            if zone.kind is ZoneKind.BLOCKED and not zone.robots:
                for cell in zone.cells:
                    self._shut(cell)
        self._redirect()
        self._dispatcher.require(record.id for record in state.robots.values() if record.unreachable)
        for zone in (*gone, *made):
            if zone.kind is ZoneKind.SLOW:
                self._dispatcher.send_again(state.zone_users(zone))
        return len({zone.id for zone in (*gone, *made)})

    def _redirect(self) -> None:
        """Take from robots the parts of their paths that zones do not allow any more."""
        state = self._state
        closed = state.zones.closed(state.grid)
        limited = state.zones.of_kind(ZoneKind.LIMITED)
        users = {zone.id: state.zone_users(zone) for zone in limited}
        for record in sorted(state.robots.values(), key=lambda record: record.id):
            route = state.ledger.route(record.id)
            if record.phase is not Phase.ACTIVE or len(route) < 2:  # noqa: PLR2004 - a path has two cells
                continue
            forbidden = state.forbidden(record.id, lambda zone: users[zone.id])
            own_closed = state.zones.closed_for(record.id, state.grid)
            wrong = [
                index
                for index, (before, cell) in enumerate(pairwise(route), start=1)
                if (before, cell) in closed
                or (before, cell) in own_closed
                or (cell in forbidden and before not in forbidden)
            ]
            if not wrong:
                continue
            record.replans += 1
            self._take_path(record, wrong[0], "a zone on its path changed")
            kept = state.ledger.claims(record.id).union(state.ledger.route(record.id))
            for zone in limited:
                if kept.isdisjoint(state.zones.cells(zone)):
                    users[zone.id].discard(record.id)

    # Both

    def _shut(self, cell: int) -> None:
        """Block a cell once no robot claims it; take their paths from robots that it is on."""
        state = self._state
        if cell in state.grid.blocked or state.is_shut(cell):
            return
        state.want_blocked(cell)
        self._dispatcher.left.add(cell)
        self._dispatcher.require(())
        for robot in sorted(state.ledger.visitors(cell)):
            record = state.robots[robot]
            route = state.ledger.route(robot)
            if record.phase is Phase.ACTIVE and cell in route[1:]:
                record.replans += 1
                self._take_path(record, route.index(cell, 1), f"cell {cell} on its path is blocked")
        owner = state.ledger.owner(cell)
        if owner is not None:
            self._dispatcher.require([owner])

    def _take_path(self, record: RobotRecord, index: int, reason: str) -> None:
        """Take a robot's path from cell number ``index`` on; stop it if that is granted already."""
        ledger = self._state.ledger
        if index < len(ledger.granted(record.id)) or not self._dispatcher.settings.repairs:
            self._dispatcher.hold(record, reason)
            return
        ledger.truncate(record.id, keep=index)
        self._state.touch(record)
        self._dispatcher.require([record.id])

    def _release(self, cells: Iterable[int]) -> None:
        """Let robots enter cells again that are not blocked for another reason."""
        state = self._state
        opened = [cell for cell in cells if not state.has_reason(cell)]
        if not opened:
            return
        was_blocked = not state.blocked.isdisjoint(opened)
        for cell in opened:
            state.free(cell)
        self._dispatcher.to_settle.update(state.index.hindered.at(opened))
        if was_blocked:
            self._dispatcher.out.append(BlockedChanged(tuple(sorted(state.blocked))))
        self._dispatcher.require(record.id for record in state.robots.values() if record.unreachable)
