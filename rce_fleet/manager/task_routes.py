"""The routes of tasks."""

from __future__ import annotations

import asyncio
from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING

from rce_fleet.api.tasks import (
    CancelledTasks,
    HoldRequest,
    LoadRequest,
    TaskChange,
    TaskPage,
    TaskRequest,
)
from rce_fleet.exceptions import UnknownTaskError
from rce_fleet.manager.convert import changed_order, read_order, show_task
from rce_fleet.manager.requests import BadRequestError, Call, FleetAnswer, Route, problem, shown
from rce_fleet.tasks.loads import settle_load
from rce_fleet.tasks.task import TaskState

if TYPE_CHECKING:
    from rce_fleet.api.tasks import TaskModel
    from rce_fleet.tasks.task import Task

MOST_OPEN = 10_000
"""Tasks that have not ended; more are refused until some have. Each step looks at all of them: at so many for
20 ms, at 50 000 for 0.3 s, in which nothing else is answered."""
MOST_OF_ONE = 8_000
"""Those of one requester, so that a program in a loop leaves room for the tasks of others."""
MOST_CANCELLED = 1_000
"""Tasks that one request cancels."""
_AT_ONCE = 100
"""Tasks of a page that are shown or cancelled without a pause, so that a step need not wait for all."""
_MORE_STATES = ("open", "ended", "recurring")
"""Words for several states; recurring: another occurrence follows, also if this one has ended."""


async def create(call: Call) -> FleetAnswer:
    """Accept a task."""
    model = call.model(TaskRequest)
    key = call.request.key or model.key
    if call.request.key and model.key not in ("", call.request.key):
        raise BadRequestError("the header Idempotency-Key and the field key differ; give one of them")
    book = call.manager.book
    is_known = bool(key) and book.with_key(call.request.user, key) is not None
    if not is_known and (refusal := _refuse_more(call)):
        return problem(429, refusal)
    before = book.number
    task = book.create(read_order(model), call.now, user=call.request.user, key=key)
    is_new = book.number != before
    await call.manager.commit()
    return _answer(call, task, 201 if is_new else 200)


async def listed(call: Call) -> FleetAnswer:
    """Return a page of tasks."""
    call.only("state", "robot", "limit", "cursor", "order", "requester", "deadline_before")
    states = _states(call)
    limit = call.count("limit", 100, 1000) or 100
    before = call.number("deadline_before", None)
    found: list[Task] = []
    for number in _numbers(call, states):
        task = call.manager.book.tasks[number]
        if before is not None and (task.order.deadline is None or task.order.deadline >= before):
            continue
        if _fits(task, call.query):
            found.append(task)
            if len(found) > limit:
                break
    page = found[:limit]
    following = str(page[-1].number) if len(found) > limit else None
    models = []
    for number, task in enumerate(page, 1):
        models.append(_show(call, task))
        if number % _AT_ONCE == 0:
            await asyncio.sleep(0)
    return shown(TaskPage(tasks=models, next=following))


async def read(call: Call) -> FleetAnswer:
    """Return a task."""
    return _answer(call, call.manager.book.find(call.names[0]))


async def change(call: Call) -> FleetAnswer:
    """Change a task."""
    model = call.model(TaskChange)
    book = call.manager.book
    order = changed_order(book.find(call.names[0]).order, model)
    task = book.change(call.names[0], order, call.now, user=call.request.user, revision=call.revision())
    await call.manager.commit()
    return _answer(call, task)


async def cancel(call: Call) -> FleetAnswer:
    """Cancel a task."""
    task = call.manager.book.cancel(call.names[0], call.now, user=call.request.user, revision=call.revision())
    await call.manager.commit()
    return _answer(call, task)


async def cancel_many(call: Call) -> FleetAnswer:
    """Cancel tasks of a requester, of a robot or in some states: the oldest first, so many at once."""
    call.only("state", "robot", "requester", "limit")
    if not any(call.query.get(name) for name in ("state", "robot", "requester")):
        raise BadRequestError("give state, robot or requester: state=open cancels all that have not ended")
    if call.revision() is not None:
        raise BadRequestError("If-Match is for one task: leave it out")
    limit = call.count("limit", MOST_CANCELLED, MOST_CANCELLED) or MOST_CANCELLED
    manager, user = call.manager, call.request.user
    tasks = (manager.book.tasks[number] for number in manager.book.numbers(_states(call)))
    names = [task.id for task in tasks if task.can_be_cancelled and _fits(task, call.query)]
    cancelled: list[str] = []
    for begin in range(0, min(limit, len(names)), _AT_ONCE):
        for name in names[begin : min(begin + _AT_ONCE, limit)]:
            if _can_be_cancelled(call, name):  # it may have ended, or was cancelled, meanwhile
                manager.book.cancel(name, manager.clock(), user=user)
                cancelled.append(name)
        await manager.commit()
    return shown(CancelledTasks(tasks=cancelled, left=max(0, len(names) - limit)))


async def hold(call: Call) -> FleetAnswer:
    """Hold a task."""
    reason = call.model(HoldRequest).reason
    task = call.manager.book.hold(
        call.names[0], call.now, user=call.request.user, reason=reason, revision=call.revision()
    )
    await call.manager.commit()
    return _answer(call, task)


async def resume(call: Call) -> FleetAnswer:
    """End the hold of a task."""
    task = call.manager.book.resume(call.names[0], call.now, user=call.request.user, revision=call.revision())
    await call.manager.commit()
    return _answer(call, task)


async def reassign(call: Call) -> FleetAnswer:
    """Give a task to another robot."""
    robot = call.manager.book.find(call.names[0]).robot
    task = call.manager.book.reassign(
        call.names[0], call.now, user=call.request.user, revision=call.revision()
    )
    call.manager.dispatcher.avoid(task, robot, call.now)
    await call.manager.commit()
    return _answer(call, task)


async def confirm(call: Call) -> FleetAnswer:
    """Confirm the action that is under way."""
    task = call.manager.book.confirm(
        call.names[0], call.now, user=call.request.user, revision=call.revision()
    )
    await call.manager.commit()
    return _answer(call, task)


async def load(call: Call) -> FleetAnswer:
    """Say where the load of a task is whose robot does not come back."""
    cell = call.model(LoadRequest).cell
    task = settle_load(
        *(call.manager.book, call.names[0], cell, call.now),
        user=call.request.user,
        revision=call.revision(),
    )
    await call.manager.commit()
    return _answer(call, task)


ROUTES = [
    Route("POST", "/tasks", create, changes=True),
    Route("GET", "/tasks", listed),
    Route("DELETE", "/tasks", cancel_many, changes=True),
    Route("GET", "/tasks/{id}", read),
    Route("PATCH", "/tasks/{id}", change, changes=True),
    Route("DELETE", "/tasks/{id}", cancel, changes=True),
    Route("POST", "/tasks/{id}/hold", hold, changes=True),
    Route("POST", "/tasks/{id}/resume", resume, changes=True),
    Route("POST", "/tasks/{id}/reassign", reassign, changes=True),
    Route("POST", "/tasks/{id}/confirm", confirm, changes=True),
    Route("POST", "/tasks/{id}/load", load, changes=True),
]


def _refuse_more(call: Call) -> str:
    """Return why no more tasks are accepted from the requester now; empty: they are."""
    book, user = call.manager.book, call.request.user
    if book.open_count >= MOST_OPEN:
        return f"there are {MOST_OPEN} open tasks; wait until some have ended"
    if user and book.open_count_of(user) >= MOST_OF_ONE:
        return (
            f"{user} has {MOST_OF_ONE} open tasks, the most of one requester; wait until some have ended, or"
            " cancel them (DELETE /tasks?requester=...)"
        )
    return ""


def _states(call: Call) -> set[str]:
    """Return the states that the query names.

    Raises:
        BadRequestError: One of them is unknown.
    """
    states = {state for state in call.query.get("state", "").split(",") if state}
    unknown = states - {state.value for state in TaskState} - {*_MORE_STATES}
    if unknown:
        possible = ", ".join([*(state.value for state in TaskState), *_MORE_STATES])
        raise BadRequestError(f"unknown state {min(unknown)!r}; possible are {possible}")
    return states


def _can_be_cancelled(call: Call, name: str) -> bool:
    try:
        return call.manager.book.find(name).can_be_cancelled
    except UnknownTaskError:
        return False  # it was forgotten


def _numbers(call: Call, states: set[str]) -> list[int]:
    """Return the numbers of the tasks in some states that come after the cursor, in the order asked for."""
    order = call.query.get("order", "asc")
    if order not in ("asc", "desc"):
        raise BadRequestError(f"order must be asc or desc, not {order!r}")
    cursor = call.query.get("cursor", "")
    if cursor and not (cursor.isdecimal() and len(cursor) < 19):  # noqa: PLR2004 - digits of a 64-bit number
        raise BadRequestError(f"cursor must be the field next of a page before, not {cursor!r}")
    numbers = call.manager.book.numbers(states)
    if order == "desc":
        return numbers[: bisect_left(numbers, int(cursor)) if cursor else None][::-1]
    return numbers[bisect_right(numbers, int(cursor)) :] if cursor else numbers


def _fits(task: Task, query: dict[str, str]) -> bool:
    if "robot" in query and task.robot != query["robot"]:
        return False
    return "requester" not in query or task.requester == query["requester"]


def _show(call: Call, task: Task) -> TaskModel:
    dispatcher = call.manager.dispatcher
    expected = dispatcher.expected_end(task, call.now)
    return show_task(task, expected, dispatcher.earliest_end(task, call.now))


def _answer(call: Call, task: Task, status: int = 200) -> FleetAnswer:
    return shown(_show(call, task), status, task.revision)
