"""Tells robots to whose goals no path leads from those that wait for room in a limited zone. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.path_search import FAR, moves_to
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.zones import ZoneKind

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord


def note_unreachable(
    state: FleetState, record: RobotRecord, *, is_unreachable: bool, barred: Collection[int]
) -> None:
    """Note whether a path leads to a robot's goal, and which limited zone is in the way if none does.

    Args:
        state: The fleet.
        record: The robot; it is changed.
        is_unreachable: Whether no path was found.
        barred: Cells that it could not enter when it was searched, with those of zones that were full.
    """
    full_zone = ""
    if is_unreachable:
        full = frozenset(barred) - state.zones.forbidden(record.id)
        full_zone = _zone_in_the_way(state, record, full) if full else ""
    if (record.unreachable, record.full_zone) != (is_unreachable, full_zone):
        record.unreachable, record.full_zone = is_unreachable, full_zone
        state.touch(record)


def _zone_in_the_way(state: FleetState, record: RobotRecord, full: frozenset[int]) -> str:
    """Return the first full zone on the way to a robot's goal; empty if something else is in the way."""
    start, goal = state.ledger.end_of_grant(record.id), record.goal
    shut = state.shut | state.zones.forbidden(record.id)
    for other in state.robots.values():
        if other.phase is not Phase.ACTIVE and other is not record:
            shut |= state.ledger.claims(other.id)
    if start is None or goal is None or goal in shut:
        return ""
    neighbours, closed = state.grid.neighbours, state.closed(record.id)
    moves = moves_to(goal, neighbours, shut, closed, start)
    if moves[start] >= FAR:
        return ""
    if goal not in full and moves_to(goal, neighbours, shut | full, closed, start)[start] < FAR:
        return ""
    cell = start
    while cell != goal and (cell == start or cell not in full):
        nearer = (way for way in neighbours[cell] if way not in shut and moves[way] < moves[cell])
        cell = next(way for way in nearer if (cell, way) not in closed)
    limited = (zone for zone in state.zones.of_kind(ZoneKind.LIMITED) if zone.applies_to(record.id))
    return next((zone.id for zone in limited if cell in state.zones.cells(zone)), "")
