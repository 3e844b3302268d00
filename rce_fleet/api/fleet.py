"""Models of robots, places, zones, map, statistics and events below ``/api/v1``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, field_validator

from rce_fleet.api.tasks import ApiModel, Cell, Moment, numbers_only
from rce_fleet.limits import (
    LEAST_CAPACITY,
    LEAST_FACTOR,
    LEAST_SPEED,
    MOST_AMOUNT,
    MOST_FACTOR,
    MOST_REASON,
    MOST_SPEED,
)

ZoneKindName = Literal["blocked", "slow", "one_way", "limited", "cost"]
ZoneFactor = Annotated[float, Field(ge=LEAST_FACTOR, le=MOST_FACTOR)]
_FORMER_KINDS = {"one-way": "one_way", "room": "limited"}


class ProfileModel(ApiModel):
    """What a robot can do, and what it takes out of its battery."""

    capabilities: list[str] = Field(default_factory=list, description="Names of what it has.", max_length=50)
    payload: float = Field(default=5.0, description="Most that it carries, kilograms.", ge=0, le=MOST_AMOUNT)
    speed: float = Field(
        default=0.4, description="Mean speed, metres per second.", ge=LEAST_SPEED, le=MOST_SPEED
    )
    capacity: float = Field(
        default=60.0,
        description="Energy of the full battery, watt hours.",
        ge=LEAST_CAPACITY,
        le=MOST_AMOUNT,
    )
    drive: float = Field(default=0.012, description="Watt hours for each metre.", ge=0, le=MOST_AMOUNT)
    idle: float = Field(
        default=8.0, description="Watts of electronics, sensors and computer.", ge=0, le=MOST_AMOUNT
    )
    acting: float = Field(
        default=5.0, description="Watts of an action at a stop, beside idle.", ge=0, le=MOST_AMOUNT
    )
    charging: float = Field(
        default=30.0, description="Watts that a charger gives.", ge=LEAST_CAPACITY, le=MOST_AMOUNT
    )
    zone_cost: dict[str, ZoneFactor] = Field(
        default_factory=dict,
        description="How much a metre counts for it, by zone; 1 is as elsewhere.",
    )
    loaded_zone_cost: dict[str, ZoneFactor] = Field(
        default_factory=dict,
        description="The same for its planned ways while it carries a load, in place of zone_cost.",
    )


class FleetRobotModel(ApiModel):
    """A robot as planner and manager see it."""

    id: str
    state: str = Field(
        description="joining, stopping, silent, lost, unreachable, driving, waiting, arrived, idle, or its"
        " mode; away: not known to the planner."
    )
    activity: str = Field(
        description="task, charging, waiting for a charger, parking, idle, paused, out or by hand."
    )
    mode: str = Field(
        description="Who drives it: automatic (the planner), paused, stopped (emergency), manual,"
        " out_of_service or dead."
    )
    mode_reason: str = Field(default="", description="Why it has its mode, as who set it said.")
    reason: str
    cell: int | None
    goal: int | None
    battery: float | None = Field(description="Share of the full battery, 0 .. 1; null: not known.")
    task: str | None = Field(description="The task that it does.")
    queue: list[str] = Field(description="Tasks that it does after that.")
    loads: list[str] = Field(
        default_factory=list,
        description="What it carries: the label of the stop where it took each load, or its task.",
    )
    profile: ProfileModel
    revision: int


class RobotList(ApiModel):
    """Robots by name: all, a page of them, or those that changed."""

    robots: list[FleetRobotModel]
    next: str | None = Field(
        default=None, description="The cursor of the next page; null: these are the last."
    )
    version: int | None = Field(
        default=None, description="With since: ask with it for robots that change after this answer."
    )


class RobotChange(ApiModel):
    """A new profile of a robot; null: the fleet's default."""

    profile: ProfileModel | None


class ChargersModel(ApiModel):
    """Cells with a purpose, and who charges."""

    _numbers = field_validator("chargers", "parking", "returns", mode="before")(numbers_only)

    chargers: list[Cell] = Field(default_factory=list, description="Cells with a charger.", max_length=10000)
    parking: list[Cell] = Field(
        default_factory=list, description="Cells where idle robots wait.", max_length=10000
    )
    returns: list[Cell] = Field(
        default_factory=list, description="Where loads of cancelled tasks are brought.", max_length=10000
    )


class ChargersState(ChargersModel):
    """Cells with a purpose, and who charges."""

    charging: dict[str, int] = Field(description="The charger of each robot that charges or goes there.")
    waiting: list[str] = Field(description="Robots that wait for a charger, the emptiest first.")
    revision: int


def _present_kind(kind: object) -> object:
    """Return a kind of zone; those of earlier releases have the planner's words now."""
    return _FORMER_KINDS.get(kind, kind) if isinstance(kind, str) else kind


class ZoneRequest(ApiModel):
    """Cells with a rule."""

    _numbers = field_validator("cells", "edges", "until", mode="before")(numbers_only)

    kind: Annotated[ZoneKindName, BeforeValidator(_present_kind)] = Field(
        description="The rule: blocked: robots do not enter it; slow: with at most this speed; one_way: not"
        " against this direction; limited: for so many robots; cost: a metre counts so much."
    )
    cells: list[Cell] = Field(default_factory=list, max_length=100000)
    value: float | None = Field(
        default=None,
        description="Metres per second, radians from the grid's columns (0, pi/2, pi, -pi/2), number of"
        " robots, or a factor; as the kind needs it.",
    )
    edges: list[Annotated[list[Cell], Field(min_length=2, max_length=2)]] = Field(
        default_factory=list,
        description="Of a blocked zone: moves [from, to] that robots do not make.",
        max_length=100000,
    )
    robots: list[str] = Field(
        default_factory=list, description="Robots that the rule is for; empty: all.", max_length=10000
    )
    reason: str = Field(default="", max_length=MOST_REASON)
    until: Moment | None = Field(default=None, description="When it ends, seconds since 1970.")


class ZoneModel(ZoneRequest):
    """A zone."""

    id: str
    user: str
    revision: int


class ZoneList(ApiModel):
    """Zones by name: all, or a page of them."""

    zones: list[ZoneModel]
    next: str | None = Field(
        default=None, description="The cursor of the next page; null: these are the last."
    )


class CellChange(ApiModel):
    """Whether a cell is blocked, why, and until when."""

    _numbers = field_validator("until", mode="before")(numbers_only)

    blocked: bool
    reason: str = Field(default="", description="Why it is blocked, for people.", max_length=MOST_REASON)
    until: Moment | None = Field(
        default=None,
        description="When a blocked cell is freed, seconds since 1970; null: it stays blocked.",
    )


class CellBlockModel(ApiModel):
    """Who blocked a cell, and why."""

    cell: int
    user: str = Field(default="", description="Who blocked it; empty: a robot's sensor, or not told.")
    robot: str = Field(
        default="", description="The robot whose sensor found it blocked; empty: people blocked it."
    )
    reason: str = ""
    since: float | None = Field(
        default=None, description="When it was blocked, seconds since 1970; null: not told."
    )
    until: float | None = Field(
        default=None, description="When it is freed, seconds since 1970; null: it stays blocked."
    )


class FleetModeChange(ApiModel):
    """Whether the fleet drives."""

    mode: Literal["automatic", "paused"] = Field(description="paused: robots get no new cells and stand.")
    reason: str = Field(default="", max_length=MOST_REASON)


class GoalChange(ApiModel):
    """The goal of a robot."""

    _numbers = field_validator("cell", mode="before")(numbers_only)

    cell: Cell | None = Field(description="Number of the goal cell; null: stop and stay.")


class GoalAnswer(ApiModel):
    """What a robot does now, for people."""

    message: str


class CellAnswer(ApiModel):
    """What became of a cell, for people."""

    message: str


class LaneModel(ApiModel):
    """A lane that robots may drive."""

    name: str
    cells: list[int] = Field(description="Its cells in order.")
    one_way: bool = Field(description="Whether robots drive it only in this order.")
    speed: float = Field(description="Greatest speed on it, metres per second; 0: not limited.")
    width: float = Field(description="Metres; 0: every robot fits.")
    cost: int = Field(description="How much a move on it counts in plans.")


class FleetMapModel(ApiModel):
    """The grid. Cells are numbered row by row from 0; row 0 is the lowest."""

    rows: int
    columns: int
    cell_size: float = Field(description="Metres.")
    origin: list[float] = Field(description="Outer corner of cell 0, metres.", min_length=2, max_length=2)
    yaw: float = Field(description="Direction of the columns, radians counter-clockwise from x.")
    walls: list[int]
    blocked: list[int] = Field(description="Blocked cells, walls left out, and cells that will be blocked.")
    blocks: list[CellBlockModel] = Field(
        default_factory=list,
        description="Who blocked them, and why, by cell; not of cells that only zones block.",
    )
    lanes: list[LaneModel] = Field(
        default_factory=list,
        description="Lanes that robots keep to, their other cells are walls; empty: all cells can be driven.",
    )


class StatisticsModel(ApiModel):
    """What the fleet did in a time."""

    seconds: float = Field(
        description="Length of the time; shorter than asked for if tasks that ended in it were forgotten."
    )
    tasks_done: int
    tasks_failed: int
    tasks_cancelled: int
    tasks_open: int
    tasks_per_hour: float
    waiting_s: float | None = Field(description="Mean time from acceptance to the start of a task, seconds.")
    duration_s: float | None = Field(description="Mean time from start to end of a task, seconds.")
    late: int = Field(description="Tasks that ended after their deadline.")
    utilization: float | None = Field(description="Share of robots' time with a task, 0 .. 1.")
    robots: int = Field(description="Robots in service.")
    battery_mean: float | None
    battery_least: float | None


class EventModel(ApiModel):
    """Something that happened."""

    number: int = Field(description="Grows by one from event to event.")
    time: float = Field(description="Seconds since 1970.")
    kind: str = Field(description="task, robot, goal, fleet, planner, places, zone or cells.")
    id: str
    name: str = Field(description="created, started, sent, arrived, acted, finished ...")
    user: str = Field(description="Who did it; empty: the manager.")
    text: str
    state: str = Field(description="Of a task: its state after the event.")
    robot: str = Field(description="Of a task: its robot.")
    revision: int


class EventPage(ApiModel):
    """Some events, the oldest first."""

    events: list[EventModel]
    next: int = Field(description="Ask with after=next for those that follow.")
    journal: str = Field(
        description="Which journal numbers the events. Another one than before: the fleet manager lost its"
        " journal, and its events are numbered from 1 again."
    )
    newest: int = Field(description="Number of the newest event of all.")


class Problem(ApiModel):
    """Why a request failed."""

    error: str
