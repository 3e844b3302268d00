"""What a simulated world is like: its time step, the robots' usual model, boxes in cells, and docks."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from rce_fleet.simulation.models import DISC, RobotModel


@dataclass(frozen=True, slots=True)
class Dock:
    """A place where standing robots are charged.

    Attributes:
        x: Its middle, metres.
        y: Its middle, metres.
        reach: How near a robot's middle must be, metres.
    """

    x: float
    y: float
    reach: float = 0.15

    def reaches(self, x: float, y: float) -> bool:
        """Return whether a robot whose middle is there is near enough."""
        return hypot(self.x - x, self.y - y) <= self.reach


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """Properties of a world.

    Attributes:
        time_step: Length of a step, seconds.
        box_size: Edge of the box in a cell, metres.
        model: The model of robots that name none.
        docks: Where robots are charged.
    """

    time_step: float = 0.02
    box_size: float = 0.6
    model: RobotModel = DISC
    docks: tuple[Dock, ...] = ()
