"""Models of tasks below ``/api/v1/tasks``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, field_validator

from rce_fleet.limits import MOST_AMOUNT, MOST_CELL, MOST_OCCURRENCES, MOST_TIME

Cell: TypeAlias = Annotated[int, Field(ge=0, le=MOST_CELL)]
Moment: TypeAlias = Annotated[float, Field(ge=0, le=MOST_TIME)]
"""Seconds since 1970."""


def _has_boolean(value: object) -> bool:
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_has_boolean, value)))


def numbers_only(value: object) -> object:
    """Return a number, or numbers in lists; refuse true and false.

    What other languages return for something that was not found would be cell 0, or the year 1970.

    Raises:
        ValueError: It is true or false, or a list has such a value.
    """
    if _has_boolean(value):
        raise ValueError("true and false do not stand for numbers")
    return value


ActionName = Literal["go", "pick", "deliver", "charge", "park"]
StateName = Literal[
    "queued", "assigned", "running", "held", "suspended", "cancelling", "done", "failed", "cancelled"
]


class ApiModel(BaseModel):
    """Base of the models: unknown fields and numbers without end are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class StopModel(ApiModel):
    """One stop of a task. Give ``cell``, or ``cells`` of which any one serves."""

    _numbers = field_validator("cell", "cells", mode="before")(numbers_only)

    action: ActionName = Field(default="go", description="What the robot does there.")
    cell: Cell | None = Field(default=None, description="Where.")
    cells: list[Cell] = Field(
        default_factory=list,
        description="Any one of these cells. A charge or park stop without cells takes any charger or"
        " parking place.",
        max_length=100,
    )
    duration: float = Field(default=0.0, description="How long the action takes, seconds.", ge=0, le=604800)
    confirm: bool = Field(default=False, description="The action ends by POST /tasks/{id}/confirm.")
    label: str = Field(default="", description="What the action is, for people.", max_length=200)


class RepeatModel(ApiModel):
    """How a task recurs."""

    every: float = Field(description="Seconds from one occurrence to the next.", ge=1, le=31622400)
    count: int | None = Field(
        default=None,
        description="Occurrences in all; null: until it is cancelled.",
        ge=1,
        le=MOST_OCCURRENCES,
    )


class OrderFields(ApiModel):
    """What a task asks for, beside its stops. Times are seconds since 1970."""

    _numbers = field_validator("deadline", "earliest_start", "return_cells", mode="before")(numbers_only)

    name: str = Field(default="", description="For people.", max_length=200)
    rounds: int = Field(default=1, description="How often the stops are made: a patrol.", ge=1, le=500)
    priority: int = Field(default=0, description="Larger numbers come first.", ge=-100, le=100)
    deadline: Moment | None = Field(default=None, description="When it should be done.")
    when_late: Literal["continue", "fail"] = Field(
        default="continue", description="At the deadline: carry it out late, or fail if no robot has begun."
    )
    earliest_start: Moment | None = Field(default=None, description="No robot begins before.")
    capabilities: list[str] = Field(
        default_factory=list, description="What the robot must have.", max_length=50
    )
    payload: float = Field(
        default=0.0, description="What the robot must carry, kilograms.", ge=0, le=MOST_AMOUNT
    )
    after: list[str] = Field(
        default_factory=list, description="Tasks that must be done before, by id.", max_length=100
    )
    robot: str = Field(default="", description="The only robot that may do it; empty: any.", max_length=128)
    return_cells: list[Cell] = Field(
        default_factory=list,
        description="Where the load is brought if the task is cancelled; empty: the fleet's return cells, or"
        " where it came from.",
        max_length=100,
    )
    repeat: RepeatModel | None = Field(default=None, description="How it recurs; null: it does not.")


class TaskRequest(OrderFields):
    """A new task."""

    stops: list[StopModel] = Field(description="In order.", min_length=1, max_length=500)
    key: str = Field(
        default="",
        description="The client's own key, as the header Idempotency-Key: a second request with it returns"
        " the first task.",
        max_length=200,
    )


class TaskChange(ApiModel):
    """A change of a task; what is left out stays as it is. Stops that were made must stay.

    A change of a recurring task that has ended counts for its next occurrence.
    """

    _numbers = field_validator("deadline", "earliest_start", "return_cells", mode="before")(numbers_only)

    stops: list[StopModel] | None = Field(default=None, min_length=1, max_length=500)
    name: str | None = Field(default=None, max_length=200)
    rounds: int | None = Field(default=None, ge=1, le=500)
    priority: int | None = Field(default=None, ge=-100, le=100)
    deadline: Moment | None = None
    when_late: Literal["continue", "fail"] | None = None
    earliest_start: Moment | None = None
    capabilities: list[str] | None = Field(default=None, max_length=50)
    payload: float | None = Field(default=None, ge=0, le=MOST_AMOUNT)
    after: list[str] | None = Field(default=None, max_length=100)
    robot: str | None = Field(default=None, max_length=128)
    return_cells: list[Cell] | None = Field(default=None, max_length=100)
    repeat: RepeatModel | None = None


class VisitModel(ApiModel):
    """A stop that a robot reached."""

    stop: int = Field(description="Its number from 0, over all rounds; -1: the return of the load.")
    robot: str
    cell: int
    started_at: float
    ended_at: float | None = Field(description="null: the action is under way.")


class TaskModel(OrderFields):
    """A task."""

    id: str
    stops: list[StopModel]
    state: StateName
    reason: str = Field(description="Why it waits, is held, suspended, or has failed.")
    question: str = Field(
        description="What people have to decide: where a load is whose robot does not come back"
        " (POST /tasks/{id}/load). Empty: nothing."
    )
    robot_assigned: str = Field(description="The robot that does it, or in whose queue it is; empty: none.")
    target: int | None = Field(description="The cell that the robot goes to or acts in.")
    position: int = Field(description="Number of stops that were made, over all rounds.")
    loads: int = Field(description="Loads of this task on its robot.")
    visits: list[VisitModel]
    requester: str
    key: str
    created_at: float
    changed_at: float = Field(description="When the state changed last.")
    started_at: float | None
    expected_end: float | None = Field(description="When it will be done, if that is known.")
    earliest_end: float | None = Field(
        default=None,
        description="Of a task without a robot: when it would be done at about the earliest, if a robot began"
        " it at its first stop now (or at its earliest start); null: it has a robot, or it is not known.",
    )
    late: bool = Field(description="Its deadline passed before it was done.")
    occurrence: int = Field(description="Number of this occurrence of a recurring task, from 1.")
    recurs_at: float | None = Field(
        default=None, description="When its next occurrence is due; null: none follows, or it was created."
    )
    revision: int = Field(description="Grows with each change; also the ETag.")


class TaskPage(ApiModel):
    """Some of the tasks, by growing number."""

    tasks: list[TaskModel]
    next: str | None = Field(description="The cursor of the next page; null: this is the last.")


class CancelledTasks(ApiModel):
    """The tasks that a request for many cancelled."""

    tasks: list[str] = Field(description="Their ids; those with a load on a robot bring it away first.")
    left: int = Field(description="How many are left: send the request again until it is 0.")


class LoadRequest(ApiModel):
    """Where the load of a task is whose robot does not come back."""

    _numbers = field_validator("cell", mode="before")(numbers_only)

    cell: Cell | None = Field(
        description="Any robot picks it up there, and continues; null: the load is lost, and the task fails."
    )


class HoldRequest(ApiModel):
    """Why a task is held, a robot is paused or taken out."""

    reason: str = Field(default="", description="For people.", max_length=500)


class PutInRequest(HoldRequest):
    """The mode of a robot that is put into service again, and why it has it."""

    mode: Literal["automatic", "paused", "stopped"] = Field(
        default="automatic", description="paused, stopped: it stands until it is resumed."
    )
