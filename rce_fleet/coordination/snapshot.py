"""The planner's state for publishing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class RobotState(Enum):
    """State of a robot, in one word."""

    JOINING = "joining"
    """It has no cell yet; ``reason`` says what it waits for."""
    STOPPING = "stopping"
    """It lost its path and is stopping."""
    SILENT = "silent"
    """No messages come from it."""
    UNREACHABLE = "unreachable"
    """No path leads to its goal now."""
    DRIVING = "driving"
    """It has cells to drive to."""
    WAITING = "waiting"
    """It waits for other robots to leave its path."""
    ARRIVED = "arrived"
    """It is at its goal."""
    IDLE = "idle"
    """It has no goal."""


@dataclass(frozen=True, slots=True)
class RobotSnapshot:
    """One robot.

    Attributes:
        id: Name of the robot.
        state: Its state.
        reason: Why it is joining, stopping or silent, for people; else empty.
        x, y, yaw: Last pose, metres and radians; not a number before the first.
        cell: Its cell.
        goal: Its goal cell.
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
        blocked: Blocked cells without the map's walls, ascending.
        pending: Cells that will be blocked as soon as the robots in them have left, ascending.
    """

    robots: tuple[RobotSnapshot, ...]
    blocked: tuple[int, ...]
    pending: tuple[int, ...]
