"""Why the planner refuses a request, or cannot give a robot its place, in words for people."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord


def refuse_goal(state: FleetState, record: RobotRecord, cell: int) -> str:
    """Why a robot cannot be sent to a cell; empty if it can."""
    if cell not in state.grid:
        return f"cell {cell} is not on the map of {len(state.grid)} cells"
    if state.is_shut(cell):
        return f"cell {cell} is blocked"
    holder = state.index.goals.get(cell, record.id)
    return "" if holder == record.id else f"cell {cell} is the goal of {holder}; choose another goal"


def refuse_block(state: FleetState, cell: int) -> str:
    """Why a cell can be neither blocked nor freed; empty if it can."""
    if cell not in state.grid:
        return f"cell {cell} is not on the map of {len(state.grid)} cells"
    return f"cell {cell} is a wall" if cell in state.grid.blocked else ""


def hindrance(
    state: FleetState, record: RobotRecord, touched: AbstractSet[int], own: AbstractSet[int], cell: int | None
) -> str:
    """Why a robot that stands still cannot take its place; empty if it can.

    Args:
        state: The fleet.
        record: The robot.
        touched: The cells that it overlaps.
        own: Those of them that no other robot claims.
        cell: The one that would be its place; None if there is none.
    """
    if not touched:
        return "it is outside of the map"
    if cell is None or (own != touched and not state.ledger.length(record.id)):
        other = min(touched - own)
        return f"cell {other} is held by {state.ledger.owner(other)}"
    if state.is_blocked(cell):
        return "it stands in a blocked cell"
    return ""
