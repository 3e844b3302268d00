"""Events that the planner handles, and instructions that it returns."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import TYPE_CHECKING

from rce_fleet.limits import MOST_METRES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.coordination.modes import RobotMode
    from rce_fleet.coordination.move_client import ClientReport
    from rce_fleet.coordination.replanning import PlanRequest, PlanResult
    from rce_fleet.coordination.zones import Zone

# Events


@dataclass(frozen=True, slots=True)
class PoseSeen:
    """A robot reported its pose: metres and radians in the map.

    Attributes:
        robot: Its name.
        x, y, yaw: The pose.
        spread: Standard deviation of the place in its worst direction, metres; None: not told.
        yaw_spread: Standard deviation of the heading, radians; None: not told.
    """

    robot: str
    x: float
    y: float
    yaw: float
    spread: float | None = None
    yaw_spread: float | None = None

    @property
    def is_possible(self) -> bool:
        """Whether a robot can be there; other poses are ignored."""
        return abs(self.x) <= MOST_METRES and abs(self.y) <= MOST_METRES and isfinite(self.yaw)


@dataclass(frozen=True, slots=True)
class RobotHeard:
    """A robot gave a sign of life ``age`` seconds ago, which is not a pose."""

    robot: str
    age: float


@dataclass(frozen=True, slots=True)
class ReportSeen:
    """A robot's move client reported its state."""

    robot: str
    report: ClientReport


@dataclass(frozen=True, slots=True)
class RobotsExpected:
    """Robots exist that may not have been heard yet; no cells are granted until they are, for a while.

    Attributes:
        robots: By name the cells that a robot may be in, because an earlier planner granted them to it;
            empty: not known.
    """

    robots: Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class ObstacleSeen:
    """A robot's sensor found cells blocked."""

    robot: str
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ObstacleGone:
    """A robot's sensor saw that nothing blocks cells any more. Cells that people blocked stay blocked."""

    robot: str
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class GoalSet:
    """A robot is sent to a cell, or (``None``) its goal is removed. Answered by :class:`Reply`."""

    robot: str
    cell: int | None


@dataclass(frozen=True, slots=True)
class CellBlocked:
    """A cell is blocked. Answered by :class:`Reply`.

    Attributes:
        cell: The cell.
        by: Who blocks it; empty: not told.
        reason: Why, for people.
        since: When it was blocked, seconds of the planner's clock; None: now.
        expires: When it is freed, seconds of the planner's clock; infinity: it stays blocked.
    """

    cell: int
    by: str = ""
    reason: str = ""
    since: float | None = None
    expires: float = inf


@dataclass(frozen=True, slots=True)
class CellFreed:
    """A blocked cell is freed. Answered by :class:`Reply`."""

    cell: int


@dataclass(frozen=True, slots=True)
class RobotRemoved:
    """A robot was removed. Answered by :class:`Reply`."""

    robot: str


@dataclass(frozen=True, slots=True)
class ZonesSet:
    """Zones are made, replaced and removed, all or none of it. Answered by :class:`Reply`.

    Attributes:
        zones: New zones, and new versions of zones with the same ids.
        remove: Ids of zones to remove; unknown ones are ignored.
        replace: Whether all other zones are removed.
        revision: The revision of the zones that the sender knows; None: whatever it is.
    """

    zones: tuple[Zone, ...]
    remove: tuple[str, ...] = ()
    replace: bool = False
    revision: int | None = None


@dataclass(frozen=True, slots=True)
class CostsSet:
    """Metres in zones count otherwise for single robots from now on. Answered by :class:`Reply`.

    Attributes:
        costs: How much a metre counts, by robot and id of the zone, in place of what the zone says. It
            replaces all such costs that were set before.
    """

    costs: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class ModeSet:
    """A robot, or (without one) the fleet, gets a mode. Answered by :class:`Reply`.

    Attributes:
        robot: Id of the robot; None: the fleet, with robots that join later.
        mode: The mode.
        reason: Why, for people.
        by: Who asked.
    """

    robot: str | None
    mode: RobotMode
    reason: str = ""
    by: str = ""


@dataclass(frozen=True, slots=True)
class PlanMade:
    """The plan that :class:`MakePlan` requested is ready."""

    result: PlanResult


@dataclass(frozen=True, slots=True)
class Tick:
    """Time passed; to be sent a few times a second."""


Event = (
    PoseSeen
    | RobotHeard
    | ReportSeen
    | RobotsExpected
    | ObstacleSeen
    | ObstacleGone
    | GoalSet
    | CellBlocked
    | CellFreed
    | RobotRemoved
    | ZonesSet
    | CostsSet
    | ModeSet
    | PlanMade
    | Tick
)

# Instructions


@dataclass(frozen=True, slots=True)
class SendCells:
    """Give a robot its granted cells, beginning with its own; an empty list means to stay.

    Attributes:
        robot: Id of the robot.
        revision: Number of the list; grows from list to list of a robot.
        cells: The granted cells.
        speed: Greatest speed in them, metres per second; infinity: as fast as the robot drives.
    """

    robot: str
    revision: int
    cells: tuple[int, ...]
    speed: float = inf


@dataclass(frozen=True, slots=True)
class SendCancel:
    """Stop a robot and drop its cells."""

    robot: str


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a request."""

    ok: bool
    message: str


@dataclass(frozen=True, slots=True)
class BlockedChanged:
    """All cells that are blocked now (without the map's walls), ascending."""

    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MakePlan:
    """Compute this plan and return it as :class:`PlanMade`. Until then no robot is granted new cells.

    There is one request at a time. It may take seconds; other events are handled meanwhile.
    """

    request: PlanRequest


@dataclass(frozen=True, slots=True)
class CellsIgnored:
    """A robot reported cells that cannot be believed.

    Attributes:
        robot: Its name.
        reason: Why they are ignored, for people.
    """

    robot: str
    reason: str


Instruction = SendCells | SendCancel | Reply | BlockedChanged | MakePlan | CellsIgnored
