"""Turns the API's models into orders and records, and back."""

from __future__ import annotations

from dataclasses import asdict, replace
from math import isfinite
from typing import TYPE_CHECKING, Any

from rce_fleet.api.fleet import ProfileModel
from rce_fleet.api.tasks import RepeatModel, StopModel, TaskChange, TaskModel, TaskRequest, VisitModel
from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.tasks.order import Action, Order, Stop, WhenLate
from rce_fleet.tasks.records import RobotProfile

if TYPE_CHECKING:
    from rce_fleet.tasks.task import Task

_LISTS = ("capabilities", "after", "return_cells")


def read_stop(model: StopModel) -> Stop:
    """Return a stop.

    Raises:
        TaskRefusedError: It has both ``cell`` and ``cells``.
    """
    if model.cell is not None and model.cells:
        raise TaskRefusedError("a stop has either cell or cells, not both")
    cells = tuple(dict.fromkeys(model.cells)) if model.cell is None else (model.cell,)
    return Stop(Action(model.action), cells, model.duration, model.confirm, model.label)


def read_order(model: TaskRequest) -> Order:
    """Return what a request for a task asks for.

    Raises:
        TaskRefusedError: A stop is not clear.
    """
    return Order(
        stops=tuple(read_stop(stop) for stop in model.stops),
        rounds=model.rounds,
        name=model.name,
        priority=model.priority,
        deadline=model.deadline,
        when_late=WhenLate(model.when_late),
        earliest_start=model.earliest_start,
        capabilities=tuple(model.capabilities),
        payload=model.payload,
        after=tuple(model.after),
        robot=model.robot,
        return_cells=tuple(model.return_cells),
        every=None if model.repeat is None else model.repeat.every,
        occurrences=None if model.repeat is None else model.repeat.count,
    )


def changed_order(order: Order, change: TaskChange) -> Order:
    """Return an order with a change.

    Raises:
        TaskRefusedError: A stop is not clear, or a field is null that must have a value.
    """
    fields: dict[str, Any] = {}
    for name in change.model_fields_set:
        value = getattr(change, name)
        if value is None and name not in ("deadline", "earliest_start", "repeat"):
            raise TaskRefusedError(f"{name} must have a value; leave it out to keep the present one")
        if name == "stops":
            fields["stops"] = tuple(read_stop(stop) for stop in value)
        elif name == "repeat":
            fields["every"] = None if value is None else value.every
            fields["occurrences"] = None if value is None else value.count
        elif name == "when_late":
            fields[name] = WhenLate(value)
        else:
            fields[name] = tuple(value) if name in _LISTS else value
    return replace(order, **fields)


def show_task(task: Task, expected_end: float | None, earliest_end: float | None = None) -> TaskModel:
    """Return a task for the API."""
    order = task.order
    return TaskModel(
        name=order.name,
        rounds=order.rounds,
        priority=order.priority,
        deadline=order.deadline,
        earliest_start=order.earliest_start,
        payload=order.payload,
        robot=order.robot,
        capabilities=list(order.capabilities),
        after=list(order.after),
        return_cells=list(order.return_cells),
        when_late=order.when_late.value,
        repeat=None if order.every is None else RepeatModel(every=order.every, count=order.occurrences),
        id=task.id,
        stops=[_show_stop(stop) for stop in order.stops],
        state=task.state.value,
        reason=task.reason,
        question=task.question,
        robot_assigned=task.robot,
        target=task.target,
        position=task.position,
        loads=task.loads,
        visits=[
            VisitModel(
                stop=visit.stop,
                robot=visit.robot,
                cell=visit.cell,
                started_at=visit.started_at,
                ended_at=visit.ended_at,
            )
            for visit in task.visits
        ],
        requester=task.requester,
        key=task.key,
        created_at=task.created_at,
        changed_at=task.changed_at,
        started_at=task.started_at,
        expected_end=expected_end,
        earliest_end=earliest_end,
        late=task.late,
        occurrence=task.occurrence,
        recurs_at=task.recurs_at,
        revision=task.revision,
    )


def _show_stop(stop: Stop) -> StopModel:
    return StopModel(
        action=stop.action.value,
        cell=stop.cells[0] if len(stop.cells) == 1 else None,
        cells=[] if len(stop.cells) == 1 else list(stop.cells),
        duration=stop.duration,
        confirm=stop.confirm,
        label=stop.label,
    )


def read_profile(model: ProfileModel) -> RobotProfile:
    """Return a robot's profile."""
    fields = model.model_dump()
    return RobotProfile(**{**fields, "capabilities": tuple(fields["capabilities"])})


def show_profile(profile: RobotProfile) -> ProfileModel:
    """Return a profile for the API, without zones that the robot may not enter."""
    costs = {name: factor for name, factor in profile.zone_cost.items() if isfinite(factor)}
    fields = {**asdict(profile), "capabilities": list(profile.capabilities), "zone_cost": costs}
    return ProfileModel(**fields)
