"""Who blocked single cells, why, since when and until when: people one by one, or robots' sensors. Pure.

Zones, which block many cells at once, have the same in :mod:`rce_fleet.coordination.zones`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class CellBlock:
    """Why a cell is blocked, apart from zones.

    Attributes:
        by: Who blocked it: a user, or the robot whose sensor found it blocked; empty: not told.
        since: When, seconds of the planner's clock.
        reason: Why, for people.
        expires: When it is freed, seconds of the planner's clock; infinity: it stays.
        sensed: Whether a robot's sensor found it blocked.
    """

    by: str
    since: float
    reason: str = ""
    expires: float = inf
    sensed: bool = False


def renewed(known: CellBlock | None, made: CellBlock) -> CellBlock:
    """Return the block of a cell that is blocked once more.

    The newest one counts; for the same user and reason the cell has been blocked since the first one.

    Args:
        known: The block until now; None: the cell was not blocked.
        made: The new one.
    """
    if known is None or (known.by, known.reason) != (made.by, made.reason):
        return made
    return replace(made, since=min(known.since, made.since))


def ended(blocks: Mapping[int, CellBlock], now: float) -> list[int]:
    """Return the cells whose blocks have ended, ascending.

    Args:
        blocks: By cell.
        now: Seconds of the planner's clock.
    """
    return sorted(cell for cell, block in blocks.items() if block.expires <= now)
