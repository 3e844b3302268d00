"""Boxes that come and go."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.simulation.walls import Block

if TYPE_CHECKING:
    from rce_fleet.geometry.poses import Pose


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
