"""Who blocked a cell, and why: as the planner's messages have it, and as the manager keeps it. Pure.

Messages have seconds from now, the manager keeps seconds since 1970.
"""

from __future__ import annotations

from typing import Any

from rce_fleet.limits import MOST_LIFETIME, MOST_REASON, MOST_TIME, within
from rce_fleet.tasks.records import CellBlock

_LEAST_LIFETIME = 0.001
"""Seconds; 0 would mean that the cell stays blocked."""


def block_request(cell: int, block: CellBlock | None, now: float) -> dict[str, Any]:
    """Return the fields of a ``fleet/BlockCell`` request.

    Args:
        cell: The cell.
        block: Who blocks it, and why; None: it is freed.
        now: Seconds since 1970.
    """
    if block is None:
        return {"cell": cell, "blocked": False}
    return {
        "cell": cell,
        "blocked": True,
        "reason": block.reason,
        "by": block.user,
        "age": 0.0 if block.since is None else within(now - block.since, 0.0, MOST_LIFETIME),
        "lifetime": 0.0 if block.until is None else within(block.until - now, _LEAST_LIFETIME, MOST_LIFETIME),
    }


def read_block(message: dict[str, Any], now: float) -> CellBlock:
    """Return who blocked a cell, and why, of a ``fleet/BlockedCell`` in its JSON form.

    Args:
        message: The message.
        now: Seconds since 1970.
    """
    who = "robot" if message["sensed"] else "user"
    return CellBlock(
        reason=message["reason"][:MOST_REASON],
        since=within(now - message["age"], 0.0, MOST_TIME),
        until=min(now + message["lifetime"], MOST_TIME) if message["lifetime"] else None,
        **{who: message["by"]},
    )


def describe_block(cell: int, block: CellBlock) -> str:
    """Return that a cell is blocked, and why, for people."""
    return f"cell {cell} is blocked" + (f": {block.reason}" if block.reason else "")
