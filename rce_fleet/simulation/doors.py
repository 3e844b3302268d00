"""Doors that open and close: at times, or when they are told to."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin
from typing import TYPE_CHECKING

from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.walls import Block

if TYPE_CHECKING:
    from collections.abc import Callable

CLEARANCE = 0.05
"""A door leaf stops this far before a robot or a walker, metres."""


@dataclass(frozen=True, slots=True)
class DoorSpec:
    """A door leaf.

    Attributes:
        x: The hinge, metres; of a sliding door, the end that it slides towards.
        y: The hinge, metres.
        yaw: Direction of the closed leaf from the hinge, radians.
        width: Length of the leaf, metres.
        thickness: Metres.
        swing: Angle by which the open leaf is turned, radians; 0 for a sliding door.
        seconds: Time that opening takes.
        open: Whether it is open at the start.
        times: Seconds at which it begins to move, to the other side each time.
        period: Seconds after which ``times`` repeat; 0: never.
        glass: Whether sensors may see through it.
    """

    x: float
    y: float
    yaw: float = 0.0
    width: float = 0.9
    thickness: float = 0.05
    swing: float = pi / 2
    seconds: float = 2.0
    open: bool = False
    times: tuple[float, ...] = ()
    period: float = 0.0
    glass: bool = False


class Door:
    """A door in a world. Created by :meth:`rce_fleet.simulation.world.World.add_door`.

    Attributes:
        id: Name of the door.
        spec: Its properties.
        opening: How far it is open, 0 (closed) .. 1 (open).
        wanted: Whether it is to be open; None: as ``spec.times`` say.
        held: Whether something in its way stops it.
    """

    def __init__(self, door: str, spec: DoorSpec) -> None:
        self.id = door
        self.spec = spec
        self.opening = 0.0
        self.wanted: bool | None = None
        self.held = False
        self.reset()

    def reset(self) -> None:
        """Stand as at the start."""
        self.opening = 1.0 if self.spec.open else 0.0
        self.wanted = None
        self.held = False

    @property
    def block(self) -> Block:
        """The leaf."""
        return self._leaf(self.opening)

    def advance(self, now: float, dt: float, in_the_way: Callable[[Block, float], bool]) -> bool:
        """Move for ``dt`` seconds; return whether the leaf moved.

        Args:
            now: Simulated time, seconds.
            dt: Length of the step, seconds.
            in_the_way: Tells whether something is nearer to a block than a distance in metres.
        """
        goal = 1.0 if self._is_to_be_open(now) else 0.0
        if self.opening == goal:
            self.held = False
            return False
        step = dt / max(self.spec.seconds, dt)
        opening = min(1.0, self.opening + step) if goal else max(0.0, self.opening - step)
        self.held = in_the_way(self._leaf(opening), CLEARANCE)
        if not self.held:
            self.opening = opening
        return not self.held

    def _is_to_be_open(self, now: float) -> bool:
        if self.wanted is not None:
            return self.wanted
        spec = self.spec
        if not spec.period:
            changes = sum(time <= now for time in spec.times)
        else:
            turns, rest = divmod(now, spec.period)
            changes = int(turns) * len(spec.times) + sum(time <= rest for time in spec.times)
        return spec.open ^ bool(changes % 2)

    def _leaf(self, opening: float) -> Block:
        spec = self.spec
        yaw = spec.yaw + spec.swing * opening
        along = spec.width / 2 - (0.0 if spec.swing else spec.width * opening)
        pose = Pose(spec.x + cos(yaw) * along, spec.y + sin(yaw) * along, yaw)
        return Block.box(pose, spec.width, spec.thickness, glass=spec.glass)
