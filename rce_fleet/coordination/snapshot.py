"""The planner's state as the outside sees it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class RobotState(Enum):
    """What a robot does, in one word."""

    JOINING = "joining"
    """It has no cell yet; ``reason`` says what it waits for."""
    STOPPING = "stopping"
    """It lost its path and is being stopped."""
    SILENT = "silent"
    """It is not heard."""
    UNREACHABLE = "unreachable"
    """There is no way to its goal at present."""
    DRIVING = "driving"
    """It has cells to drive to."""
    WAITING = "waiting"
    """It waits for others to clear its way."""
    ARRIVED = "arrived"
    """It is at its goal."""
    IDLE = "idle"
    """It has no goal."""


@dataclass(frozen=True, slots=True)
class RobotSnapshot:
    """One robot.

    Attributes:
        id: Name of the robot.
        state: What it does.
        reason: Why it is joining, stopping or silent, for people; else empty.
        x, y, yaw: Last pose, metres and radians; not a number before the first.
        cell: The cell that it has its place in.
        goal: Where it was sent.
        plan: Its cell and all cells that it will enter.
        granted: Those of them that are its own now.
        replans: How often it lost its path because a cell of it was blocked.
    """

    id: str
    state: RobotState
    reason: str
    x: float
    y: float
    yaw: float
    cell: int | None
    goal: int | None
    plan: tuple[int, ...]
    granted: tuple[int, ...]
    replans: int


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """The fleet.

    Attributes:
        robots: By name.
        blocked: Blocked cells, walls of the map not counted, ascending.
        pending: Cells that will be blocked as soon as the robots in them have left, ascending.
    """

    robots: tuple[RobotSnapshot, ...]
    blocked: tuple[int, ...]
    pending: tuple[int, ...]
