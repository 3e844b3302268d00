"""Reasons of the planner for refusing a request or not placing a robot, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.modes import WORDS

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord
    from rce_fleet.coordination.zones import Zone


def refuse_goal(state: FleetState, record: RobotRecord, cell: int) -> str:
    """Return why a robot cannot be sent to a cell; empty if it can."""
    if cell not in state.grid:
        return f"cell {cell} is not on the map of {len(state.grid)} cells"
    if not record.mode.takes_goals:
        return f"{record.id} is {WORDS[record.mode]}: set its mode to automatic first"
    zone = state.zones.blocks(cell)
    if zone is not None:
        return f"cell {cell} is blocked by {describe_zone(zone)}; choose another goal"
    if cell in state.zones.forbidden(record.id):
        return f"cell {cell} is blocked for {record.id} by a zone; choose another goal"
    if state.is_shut(cell):
        what = "on no lane" if _is_off_lanes(state, cell) else "blocked"
        return f"cell {cell} is {what}; choose another goal"
    holder = state.index.goals.get(cell, record.id)
    return "" if holder == record.id else f"cell {cell} is the goal of {holder}; choose another goal"


def describe_zone(zone: Zone) -> str:
    """Return a zone's name, with its reason and author, for people."""
    details = ", ".join(filter(None, (zone.reason, f"by {zone.by}" if zone.by else "")))
    return f"zone {zone.id!r}" + (f" ({details})" if details else "")


def refuse_block(state: FleetState, cell: int) -> str:
    """Return why a cell can be neither blocked nor freed; empty if it can."""
    if cell not in state.grid:
        return f"cell {cell} is not on the map of {len(state.grid)} cells"
    if _is_off_lanes(state, cell):
        return f"cell {cell} is on no lane, so that no robot enters it"
    return f"cell {cell} is a wall" if cell in state.grid.blocked else ""


def _is_off_lanes(state: FleetState, cell: int) -> bool:
    lanes = state.zones.lanes
    return lanes is not None and cell not in lanes.cells


def hindrance(
    state: FleetState,
    record: RobotRecord,
    hull: AbstractSet[int],
    held: AbstractSet[int],
    cell: int | None,
    reachable: AbstractSet[int],
) -> str:
    """Return why a robot that stands still cannot be placed in a cell; empty if it can.

    A robot that had a cell may be partly in another robot's, if that one is there too: one of them has to
    leave first.

    Args:
        state: The fleet.
        record: The robot.
        hull: Cells that its hull overlaps.
        held: Those of them that other robots claim.
        cell: The cell to place it in; None if there is none.
        reachable: Cells of its hull that other robots claim, are not in, and may drive to.
    """
    if not hull:
        return "it is outside the map: localize it, or drive it onto the map by hand"
    if cell is None or reachable or (held and not state.ledger.length(record.id)):
        other = min(reachable or held or hull)
        return f"cell {other} is held by {state.ledger.owner(other)}"
    if _is_off_lanes(state, cell):
        return "it stands on no lane: drive it onto one by hand"
    if cell in state.grid.blocked:
        return f"it stands in cell {cell}, which is a wall: localize it, or drive it out by hand"
    if state.is_blocked(cell):
        return f"it stands in cell {cell}, which is blocked: free the cell, or drive it out by hand"
    return ""
