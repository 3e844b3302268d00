"""Reads the requests ``fleet/BlockCell``, and writes ``fleet/BlockedCell``.

Times are seconds from the message on, so that clocks of machines need not agree.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, Any

from rce_fleet.coordination.events import CellBlocked, CellFreed
from rce_fleet.limits import MOST_LIFETIME, MOST_REASON

if TYPE_CHECKING:
    from rce.ros.types import Message
    from rce_fleet.coordination.cell_blocks import CellBlock

LEAST_LIFETIME = 0.001
"""Seconds; 0 would mean that a block stays."""


def read_cell_request(request: Message, now: float) -> CellBlocked | CellFreed:
    """Return the event of a ``fleet/BlockCell`` request.

    Args:
        request: The request.
        now: The planner's time, seconds.

    Raises:
        ValueError: Age or lifetime cannot be.
    """
    if not request.blocked:
        return CellFreed(request.cell)
    for what, seconds in (("age", request.age), ("lifetime", request.lifetime)):
        if not 0 <= seconds <= MOST_LIFETIME:
            raise ValueError(
                f"cell {request.cell}: its {what} must be 0 .. {MOST_LIFETIME:g} s, not {seconds}"
            )
    return CellBlocked(
        request.cell,
        by=request.by,
        reason=request.reason[:MOST_REASON],
        since=now - request.age,
        expires=now + request.lifetime if request.lifetime else inf,
    )


def block_fields(cell: int, block: CellBlock, now: float) -> dict[str, Any]:
    """Return the fields of a ``fleet/BlockedCell``.

    Args:
        cell: The cell.
        block: Who blocked it, and why.
        now: The planner's time, seconds.
    """
    return {
        "cell": cell,
        "sensed": block.sensed,
        "by": block.by,
        "reason": block.reason,
        "age": max(now - block.since, 0.0),
        "lifetime": max(block.expires - now, LEAST_LIFETIME) if block.expires < inf else 0.0,
    }
