"""Loads that robots carry, and what people say of one whose robot does not come back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.tasks.order import Action, Order, Stop, check_cells, check_order
from rce_fleet.tasks.task import Task, TaskCause, TaskState

if TYPE_CHECKING:
    from rce_fleet.tasks.book import TaskBook

_WITH_LOAD = frozenset({TaskState.SUSPENDED, TaskState.HELD, TaskState.CANCELLING})
_TAKEOVER = "takes the load over"
"""Label of the stops where another robot picks up the load of one that does not come back."""


def settle_load(
    book: TaskBook, task_id: str, cell: int | None, now: float, *, user: str = "", revision: int | None = None
) -> Task:
    """Take the load of a task off its robot; return the task.

    With a cell, any robot picks it up there and continues; a cancelled task ends. Without one the load is
    lost, and the task fails.

    Args:
        book: The tasks.
        task_id: The task.
        cell: Where the load is; None: it is lost.
        now: Seconds since 1970.
        user: Who says so.
        revision: The revision that the task must have; None: any.

    Raises:
        TaskRefusedError: Its robot can continue, it has no load, or the cell cannot be entered.
        RevisionError: It is not at the given revision.
        UnknownTaskError: There is no such task.
    """
    task = book.at(task_id, revision)
    if not task.is_loaded or task.action is not None or task.state not in _WITH_LOAD:
        raise TaskRefusedError(
            f"{task.id} is {task.state.value}: only the load of a task that is suspended, held or being"
            " cancelled, and for which no robot acts, can be taken over"
        )
    free = replace(task, robot="", target=None)
    if cell is None:
        return _end(book, free, TaskCause.FAIL, now, user, f"its load is lost, says {user or 'a program'}")
    where = f"its load is in cell {cell}, says {user or 'a program'}"
    if task.state is TaskState.CANCELLING:
        return _end(book, free, TaskCause.CANCEL, now, user, where)
    order = with_picks(task, cell)
    check_order(order)
    if book.grid is not None:
        check_cells(order, book.grid, task.position)
    changed = replace(free, order=order, loads=0)
    if task.state is TaskState.SUSPENDED:
        return _end(book, changed, TaskCause.RELEASE, now, user, where)
    changed = replace(changed, revision=task.revision + 1)
    book.emit(changed, "load", now, user=user, text=where)
    return changed


def carried(task: Task) -> tuple[str, ...]:
    """Return the names of the loads that a robot carries for a task, the first taken first.

    A load's name is the label of the stop where it was taken, or else the task's name or id. A stop that
    delivers takes the load of its own label off the robot, or else the one that was taken first.
    """
    if not task.is_loaded:
        return ()
    unnamed, names = task.order.name or task.id, list[str]()
    for index in range(task.position):
        stop = task.order.stop(index)
        if stop.action is Action.PICK:
            names.append(stop.label or unnamed)
        elif stop.action is Action.DELIVER and names:
            names.remove(stop.label if stop.label in names else names[0])
    lacking = (unnamed,) * (task.loads - len(names))
    return (*lacking, *names[max(0, len(names) - task.loads) :])


def with_picks(task: Task, cell: int) -> Order:
    """Return a task's order with stops that pick its loads in a cell, before those that are left.

    Raises:
        TaskRefusedError: The task has rounds: a stop would be made in each of them.
    """
    order = task.order
    if order.rounds > 1:
        raise TaskRefusedError(
            f"{task.id} has {order.rounds} rounds: create a task that brings the load away, and say that it"
            " is lost"
        )
    picks = [stop for stop in order.stops[: task.position] if stop.action is Action.PICK]
    duration = max((stop.duration for stop in picks), default=0.0)
    added = (Stop(Action.PICK, (cell,), duration, label=_TAKEOVER),) * task.loads
    return replace(order, stops=(*order.stops[: task.position], *added, *order.stops[task.position :]))


def check_delivered(order: Order) -> None:
    """Check that an order delivers each load that it takes: the robot would keep it, and begin another task.

    Raises:
        TaskRefusedError: It does not.
    """
    taken = list[int]()
    for number, stop in enumerate(order.stops, 1):
        if stop.action is Action.PICK and stop.label != _TAKEOVER:  # which takes a load of a stop before it
            taken.append(number)
        elif stop.action is Action.DELIVER and taken:
            taken.pop()
    if taken:
        raise TaskRefusedError(
            f"stop {taken[0]} (pick) takes a load that no stop delivers: add a stop with the action deliver"
        )


def without_takeovers(order: Order) -> Order:
    """Return an order without the stops of :func:`with_picks`: they are for one load, not for each one."""
    stops = tuple(stop for stop in order.stops if stop.action is not Action.PICK or stop.label != _TAKEOVER)
    own = replace(order, stops=stops)
    try:
        check_order(own)
    except TaskRefusedError:
        return order  # a person gave this label to a stop that is needed
    return own


def _end(book: TaskBook, task: Task, cause: TaskCause, now: float, user: str, text: str) -> Task:
    ended = task.after(cause, now, text)
    book.emit(ended, cause.value, now, user=user, text=text)
    return ended
