"""Boxes that come and go, and the names of those in cells."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.simulation.walls import Block

if TYPE_CHECKING:
    from rce_fleet.geometry.poses import Pose

_CELL = "cell_"
"""Beginning of the name of a cell's box."""
_CELL_BOX = re.compile(rf"{_CELL}(0|[1-9][0-9]{{0,8}})")


@dataclass(frozen=True, slots=True)
class BoxSpec:
    """A box, and when it is there.

    Attributes:
        pose: Its middle.
        width: Metres along its direction.
        depth: Metres across.
        glass: Whether sensors may see through it.
        first: Second from which it is there.
        last: Second from which it is gone.
        period: Seconds after which ``first`` and ``last`` repeat; 0: never.
    """

    pose: Pose
    width: float = 0.6
    depth: float = 0.6
    glass: bool = False
    first: float = 0.0
    last: float = inf
    period: float = 0.0

    @property
    def block(self) -> Block:
        """Its shape."""
        return Block.box(self.pose, self.width, self.depth, glass=self.glass)

    @property
    def timed(self) -> bool:
        """Whether it comes and goes by itself."""
        return self.first > 0 or self.last < inf

    def is_due(self, now: float) -> bool:
        """Return whether it is to be there at a time, seconds."""
        moment = now % self.period if self.period else now
        return self.first <= moment + 1e-9 < self.last


def box_of_cell(cell: int) -> str:
    """Return the name of a cell's box."""
    return f"{_CELL}{cell}"


def cell_of_box(name: str) -> int | None:
    """Return the cell whose box has this name; None for other boxes."""
    found = _CELL_BOX.fullmatch(name)
    return None if found is None else int(found[1])
