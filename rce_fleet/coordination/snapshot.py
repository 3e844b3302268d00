"""The planner's state for publishing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce_fleet.coordination.cell_blocks import CellBlock


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
    PAUSED = "paused"
    """It stands until it is automatic again."""
    STOPPED = "stopped"
    """It stands after an emergency stop."""
    MANUAL = "manual"
    """A person drives it."""
    OUT_OF_SERVICE = "out_of_service"
    """It stands on the floor and takes no goals."""
    DEAD = "dead"
    """It lies dead on the floor."""
    LOST = "lost"
    """Its localization does not know where it is; it stands."""


@dataclass(frozen=True, slots=True)
class RobotSnapshot:
    """One robot.

    Attributes:
        id: Name of the robot.
        state: Its state.
        reason: Why it is not driving, for people; else empty.
        x, y, yaw: Last pose, metres and radians; not a number before the first.
        cell: Its cell.
        goal: Its goal cell.
        plan: Its cell and all cells that it will enter.
        granted: The base: those of them that are its own now. The rest is the horizon, which may change.
        replans: How often it lost its path because a cell of it was blocked.
        pose_only: Whether its move client answers nothing, so that its progress is judged by its poses.
        mode: Its mode; see :class:`rce_fleet.coordination.modes.RobotMode`.
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
    mode: str = "automatic"
    pose_only: bool = False


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """The fleet.

    Attributes:
        robots: By name.
        blocked: Blocked cells without the map's walls, ascending.
        pending: Cells that will be blocked as soon as the robots in them have left, ascending.
        blocks: Who blocked cells of both, and why, by cell; not of cells that only zones block.
    """

    robots: tuple[RobotSnapshot, ...]
    blocked: tuple[int, ...]
    pending: tuple[int, ...]
    blocks: tuple[tuple[int, CellBlock], ...] = ()
