"""Robots that wait for each other when cells are granted in no order. Pure.

An ordered ledger has no such robots. With the planner ``dijkstra`` two robots can meet head on, or one can
wait for another that rests on its path.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from rce_fleet.coordination.robot import Phase

if TYPE_CHECKING:
    from rce_fleet.coordination.fleet_state import FleetState

_RESTS = re.compile(r"deadlock: \S+ rests on its path, in cell (\d+)")


def resting_cell(reason: str) -> int | None:
    """Return the cell in which a robot rests on another one's path, from the reason why that one waits.

    Args:
        reason: One that :func:`find_deadlocks` gave, or another text.

    Returns:
        The cell; None: it waits for something else.
    """
    found = _RESTS.fullmatch(reason)
    return None if found is None else int(found[1])


def find_deadlocks(state: FleetState) -> dict[str, str]:
    """Return the robots that cannot drive on unless another robot gives way, and why, for people.

    Args:
        state: The fleet.
    """
    waits = _waits(state)
    reasons: dict[str, str] = {}
    for robot in waits:
        chain: dict[str, None] = {}
        last = robot
        while last in waits and last not in chain and last not in reasons:
            chain[last] = None
            last = waits[last]
        why = reasons.get(last, "")
        if last in chain:
            members = list(chain)
            circle = members[members.index(last) :]
            why = f"deadlock: {', '.join(sorted(circle))} wait for each other"
        elif last not in waits and _rests(state, last):
            why = f"deadlock: {last} rests on its path, in cell {state.ledger.route(last)[0]}"
        reasons.update(dict.fromkeys(chain, why))
    return {robot: reasons[robot] for robot in sorted(waits) if reasons[robot]}


def _waits(state: FleetState) -> dict[str, str]:
    """Return for each robot that stands at the end of its granted cells the robot that it waits for."""
    waits = {}
    for robot, record in state.robots.items():
        granted = state.ledger.granted(robot)
        if record.phase is not Phase.ACTIVE or not record.centred or len(granted) != 1:
            continue
        route = state.ledger.route(robot)
        owner = state.ledger.owner(route[1]) if len(route) > 1 else None
        if owner is not None and owner != robot:
            waits[robot] = owner
    return waits


def _rests(state: FleetState, robot: str) -> bool:
    """Return whether a robot stays where it is."""
    record = state.robots.get(robot)
    return (
        record is not None
        and record.phase is Phase.ACTIVE
        and record.centred
        and state.ledger.length(robot) == 1
        and record.goal in (None, state.ledger.end_of_grant(robot))
    )
