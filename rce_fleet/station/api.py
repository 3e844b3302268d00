"""The models of the station's HTTP API."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, field_validator

from rce_fleet.api.fleet import CellBlockModel, CellChange, LaneModel
from rce_fleet.api.tasks import numbers_only

MAX_CELL = 2**31 - 1
"""Largest number of a cell that the planner's messages hold."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class GoalRequest(_Model):
    """The goal of a robot."""

    _numbers = field_validator("cell", mode="before")(numbers_only)

    cell: int | None = Field(description="Number of the goal cell; null: stop and stay.", ge=0, le=MAX_CELL)


class CellRequest(CellChange):
    """Whether a cell is blocked, why, and until when."""


class GridRequest(_Model):
    """A grid of cells over the planner's map; what is left out stays as it is."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    cell_size: float | None = Field(default=None, description="Edge of a cell, metres.", gt=0)
    origin: list[float] | None = Field(
        default=None, description="Outer corner of cell 0, metres.", min_length=2, max_length=2
    )
    yaw: float | None = Field(
        default=None, description="Direction of the columns, radians counter-clockwise from x."
    )
    blocked_share: float | None = Field(
        default=None,
        description="A cell is blocked if more than this share of it is occupied, unknown or cut off.",
        ge=0,
        le=1,
    )


class LayersRequest(_Model):
    """The layers that a page shows; sent on the live socket, it replaces the last one."""

    robot: str = Field(description="The robot whose layers are shown.", max_length=128)
    layers: list[str] = Field(
        description="map, scan, particles, plan, local_costmap, global_costmap.", max_length=32
    )


class LoginRequest(_Model):
    """Name and password of a user of the engine."""

    userID: str = Field(max_length=256)  # noqa: N815 - its name everywhere in the protocol
    password: str = Field(max_length=1024, repr=False)


class UserModel(_Model):
    """The user of this request, and what they may do."""

    name: str
    role: str = Field(description="viewer, user, operator or admin.")
    steers: bool = Field(description="Whether the user may send robots and block cells.")
    logged_in: bool = Field(description="Whether the station has logins, so that the user can log out.")


class Answer(_Model):
    """The planner's answer."""

    message: str


class GridAnswer(_Model):
    """A grid of cells, and what the planner says of it."""

    message: str = Field(description="Of a preview: why the grid cannot be taken over now, if it cannot.")
    rows: int
    columns: int
    cell_size: float = Field(description="Metres.")
    origin: list[float] = Field(description="Outer corner of cell 0, metres.", min_length=2, max_length=2)
    yaw: float = Field(description="Direction of the columns, radians counter-clockwise from x.")
    blocked_share: float
    walls: list[int] = Field(description="Blocked cells that belong to the map and cannot be freed.")


class Problem(_Model):
    """Why the request failed."""

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
        description="joining, stopping, silent, lost, unreachable, driving, waiting, arrived or idle; or its "
        "mode: paused, stopped, manual, out_of_service or dead."
    )
    reason: str = Field(description="Why it is joining, stopping or silent; else empty.")
    cell: int | None = Field(description="The cell that it stands in or is entering.")
    goal: int | None
    plan: list[int] = Field(description="All cells of its planned path, from the current one.")
    granted: list[int] = Field(description="The first cells of the plan, which it may enter now.")
    replans: int
    mode: str = Field(default="automatic", description="automatic, or who drives it instead.")
    pose_only: bool = Field(
        default=False, description="Its move client answers nothing: its poses show its progress."
    )
    pose: PoseModel | None
    age: float | None = Field(
        default=None,
        description="Seconds since the planner had its last sign of life, or since the planner was heard "
        "last, if it does not tell this; null: not known.",
    )


class MapModel(_Model):
    """The grid. Cells are numbered row by row from 0; row 0 is the lowest."""

    rows: int
    columns: int
    cell_size: float = Field(description="Metres.")
    origin: tuple[float, float] = Field(description="Outer corner of cell 0, metres.")
    yaw: float = Field(default=0.0, description="Direction of the columns, radians counter-clockwise from x.")
    robot_radius: float = Field(description="Metres.")
    walls: list[int] = Field(description="Blocked cells that belong to the map and cannot be freed.")
    lanes: list[LaneModel] = Field(
        default_factory=list, description="Lanes that robots keep to; empty: all cells can be driven."
    )


class FleetModel(_Model):
    """The whole fleet."""

    map: MapModel | None
    robots: list[RobotModel]
    blocked: list[int]
    pending: list[int] = Field(description="Cells that will be blocked once a robot has left them.")
    blocks: list[CellBlockModel] = Field(
        default_factory=list,
        description="Who blocked cells of both lists, and why, by cell; not of cells that only zones block.",
    )
    age: float | None = Field(
        default=None,
        description="Seconds since the planner was heard last: it sends something every second; null: never.",
    )
