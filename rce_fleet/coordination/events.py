"""What the planner takes in and what it gives out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce_fleet.coordination.move_client import ClientReport
    from rce_fleet.coordination.replanning import PlanRequest, PlanResult

# Events


@dataclass(frozen=True, slots=True)
class PoseSeen:
    """A robot says where it is: metres and radians in the map."""

    robot: str
    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class ReportSeen:
    """A robot's move client says what it does."""

    robot: str
    report: ClientReport


@dataclass(frozen=True, slots=True)
class ObstacleSeen:
    """A robot's sensor found cells blocked."""

    robot: str
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class GoalSet:
    """Somebody sends a robot to a cell, or (``None``) takes its goal away. Answered by :class:`Reply`."""

    robot: str
    cell: int | None


@dataclass(frozen=True, slots=True)
class CellBlocked:
    """Somebody blocks a cell. Answered by :class:`Reply`."""

    cell: int


@dataclass(frozen=True, slots=True)
class CellFreed:
    """Somebody frees a blocked cell. Answered by :class:`Reply`."""

    cell: int


@dataclass(frozen=True, slots=True)
class RobotRemoved:
    """Somebody took a robot off the floor. Answered by :class:`Reply`."""

    robot: str


@dataclass(frozen=True, slots=True)
class PlanMade:
    """The plan that :class:`MakePlan` asked for is there."""

    result: PlanResult


@dataclass(frozen=True, slots=True)
class Tick:
    """Time goes by; wanted a few times a second."""


Event = (
    PoseSeen | ReportSeen | ObstacleSeen | GoalSet | CellBlocked | CellFreed | RobotRemoved | PlanMade | Tick
)

# Instructions


@dataclass(frozen=True, slots=True)
class SendCells:
    """Give a robot its granted cells, beginning with its own; an empty list means to stay.

    Attributes:
        robot: Whom.
        revision: Grows from list to list of a robot.
        cells: The granted cells.
    """

    robot: str
    revision: int
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SendCancel:
    """Stop a robot and let it drop its cells."""

    robot: str


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a request."""

    ok: bool
    message: str


@dataclass(frozen=True, slots=True)
class BlockedChanged:
    """These cells, all of them, are blocked from now on (walls of the map not counted), ascending."""

    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MakePlan:
    """Compute this plan and hand it in as :class:`PlanMade`. Until then no robot is granted anything new.

    There is one request at a time. It may take seconds; everything else goes on meanwhile.
    """

    request: PlanRequest


Instruction = SendCells | SendCancel | Reply | BlockedChanged | MakePlan
