"""What a scene consists of, as its file names it: walls, boxes, doors, walkers, docks, robots."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, inf, pi
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, model_validator

from rce.config.validation import Strict
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.box import BoxSpec
from rce_fleet.simulation.doors import DoorSpec
from rce_fleet.simulation.walkers import WalkerSpec
from rce_fleet.simulation.walls import Block, Walls, no_lines, polyline

Metres = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Place = Annotated[tuple[Metres, Metres], Field(strict=False)]
Size = Annotated[tuple[Length, Length], Field(strict=False)]
Id = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]

_CELL, _ITEM = "<cell>", "<item>"
TAGS = (_CELL, _ITEM)
"""Steps in the paths of pydantic's errors that are not keys."""


def _form(value: object) -> str:
    return _CELL if isinstance(value, int) else _ITEM


class WallItem(Strict):
    """A wall: a line through points, or a box of any direction."""

    line: tuple[Place, ...] = Field(default=(), strict=False)
    """Points of the wall, metres."""
    closed: bool = False
    """Whether the line goes back to its first point."""
    thickness: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    at: Place | None = None
    """Middle of a box, metres."""
    size: Size | None = None
    """Width along its direction and depth across, metres."""
    yaw: Metres = 0.0
    glass: bool = False

    @model_validator(mode="after")
    def _check_form(self) -> WallItem:
        if bool(self.line) == (self.at is not None) or (self.at is None) != (self.size is None):
            raise ValueError("a wall has either 'line', or 'at' and 'size'")
        if self.line and (len(self.line) <= 1 or not all(hypot(x, y) for x, y in self._ways())):
            raise ValueError("the line of a wall has at least two points, and no point twice in a row")
        return self

    def _ways(self) -> list[tuple[float, float]]:
        return [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(self.line)]

    def walls(self) -> Walls:
        """Return what it adds to the world."""
        if self.at is not None and self.size is not None:
            block = Block.box(Pose(*self.at, self.yaw), *self.size, glass=self.glass)
            return Walls((block,))
        # A closed line may also name its first point again at the end.
        lines = polyline(self.line, closed=self.closed and self.line[0] != self.line[-1])
        if self.thickness:
            ends = [((ax, ay), (bx, by)) for ax, ay, bx, by in lines.tolist()]
            return Walls(tuple(Block.wall(*both, self.thickness, glass=self.glass) for both in ends))
        return Walls((), *((no_lines(), lines) if self.glass else (lines, no_lines())))


class BoxItem(Strict):
    """A box that need not stand in a cell, and may come and go."""

    id: Id
    at: Place
    yaw: Metres = 0.0
    size: Size = (0.6, 0.6)
    glass: bool = False
    first: Seconds = 0.0
    """Second from which it is there."""
    last: Length | None = None
    """Second from which it is gone; never if not given."""
    period: Seconds = 0.0
    """Seconds after which this repeats; 0: never."""

    def spec(self) -> BoxSpec:
        """Return the box."""
        pose = Pose(*self.at, self.yaw)
        last = inf if self.last is None else self.last
        return BoxSpec(pose, *self.size, self.glass, self.first, last, self.period)


class DoorItem(Strict):
    """A door leaf."""

    id: Id
    at: Place
    """The hinge; of a sliding door, the end that it slides towards."""
    yaw: Metres = 0.0
    """Direction of the closed leaf from there."""
    width: Length = 0.9
    thickness: Length = 0.05
    swing: Metres = pi / 2
    """Angle by which the open leaf is turned; 0 for a sliding door."""
    seconds: Length = 2.0
    """Time that opening takes."""
    open: bool = False
    times: tuple[Seconds, ...] = Field(default=(), strict=False)
    """Seconds at which it begins to move, to the other side each time."""
    period: Seconds = 0.0
    """Seconds after which ``times`` repeat; 0: never."""
    glass: bool = False

    def spec(self) -> DoorSpec:
        """Return the door."""
        fields = self.model_dump(exclude={"id", "at"})
        return DoorSpec(*self.at, **fields)


class WalkerItem(Strict):
    """Someone who walks."""

    id: Id
    waypoints: tuple[Place, ...] = Field(min_length=1, strict=False)
    speed: Seconds = 1.0
    radius: Length = 0.2
    pause: Seconds = 0.0
    loop: bool = True
    social_distance: Seconds = 0.0
    start: Seconds = 0.0
    patience: Length | None = None
    """Seconds of waiting for a robot after which the walker turns back; never if not given."""

    def spec(self) -> WalkerSpec:
        """Return how the walker walks."""
        fields = self.model_dump(exclude={"id", "patience"})
        return WalkerSpec(**fields, patience=inf if self.patience is None else self.patience)


class DockItem(Strict):
    """A place where robots are charged."""

    at: Place
    reach: Length = 0.15


class RobotStart(Strict):
    """A robot and its start: the middle of a cell, or a place."""

    id: Id
    cell: int | None = Field(default=None, ge=0)
    at: Place | None = None
    """Metres."""
    yaw: Metres = 0.0
    """Heading, radians counter-clockwise from x."""
    model: str = ""
    """Name of its model; empty for that of the scene."""
    sensor: str = ""
    """The range sensor that makes ``/scan``; empty for the model's own choice."""
    override: dict[str, Any] = Field(default_factory=dict)
    """What is different from the model, as in a model's file."""

    @model_validator(mode="after")
    def _check_place(self) -> RobotStart:
        if (self.cell is None) == (self.at is None):
            raise ValueError("a robot has either 'cell' or 'at'")
        return self


class LightStart(Strict):
    """A light robot, and the cell in whose middle it starts."""

    id: Id
    cell: int = Field(ge=0)
    yaw: Metres = 0.0
    """Heading, radians counter-clockwise from x."""


Wall = Annotated[
    Annotated[int, Tag(_CELL)] | Annotated[WallItem, Tag(_ITEM)],
    Discriminator(_form),
]
"""A cell that is always solid, or a wall."""
Box = Annotated[
    Annotated[int, Tag(_CELL)] | Annotated[BoxItem, Tag(_ITEM)],
    Discriminator(_form),
]
"""A cell with a box in its middle, or a box."""
