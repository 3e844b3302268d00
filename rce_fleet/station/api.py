"""The models of the station's HTTP API."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

MAX_CELL = 2**31 - 1
"""Largest number of a cell that the planner's messages hold."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class GoalRequest(_Model):
    """Where a robot is to go."""

    cell: int | None = Field(description="Number of the goal cell; null: stop and stay.", ge=0, le=MAX_CELL)


class CellRequest(_Model):
    """Whether a cell is blocked."""

    blocked: bool


class LoginRequest(_Model):
    """Who wants to come in."""

    userID: str = Field(max_length=256)  # noqa: N815 - its name everywhere in the protocol
    password: str = Field(max_length=1024, repr=False)


class PersonModel(_Model):
    """Who asks, and what they may do."""

    name: str
    role: str = Field(description="viewer, user, operator or admin.")
    steers: bool = Field(description="Whether robots may be sent and cells blocked.")
    logged_in: bool = Field(description="Whether there is a login that can be ended.")


class Answer(_Model):
    """What was done, in words."""

    message: str


class Problem(_Model):
    """What was wrong, in words."""

    error: str


class PoseModel(_Model):
    """A pose in the map frame: metres, radians."""

    x: float
    y: float
    theta: float


class RobotModel(_Model):
    """One robot."""

    id: str
    state: str = Field(
        description="joining, stopping, silent, unreachable, driving, waiting, arrived or idle."
    )
    reason: str = Field(description="Why it is joining, stopping or silent; else empty.")
    cell: int | None = Field(description="Where it stands, or what it is entering.")
    goal: int | None
    plan: list[int] = Field(description="All cells of its planned path, beginning with the present one.")
    granted: list[int] = Field(description="The first cells of the plan, which it may drive now.")
    replans: int
    pose: PoseModel | None


class MapModel(_Model):
    """The grid. Cells are numbered row by row from 0; row 0 is the lowest."""

    rows: int
    columns: int
    cell_size: float = Field(description="Metres.")
    origin: tuple[float, float] = Field(description="Outer corner of cell 0, metres.")
    robot_radius: float = Field(description="Metres.")
    walls: list[int] = Field(description="Blocked cells that belong to the map and cannot be freed.")


class FleetModel(_Model):
    """The whole fleet."""

    map: MapModel | None
    robots: list[RobotModel]
    blocked: list[int]
    pending: list[int] = Field(description="Cells that will be blocked as soon as a robot has left them.")
