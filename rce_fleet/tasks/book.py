"""The book of tasks: the fleet manager's records, and the requests that change tasks.

The book is a reducer: a request or a fact comes in with its time, and events come out. The book has no clock
and does no I/O.
"""

from __future__ import annotations

from dataclasses import fields, replace
from hashlib import sha256
from typing import TYPE_CHECKING

from rce_fleet.exceptions import KeyReusedError, TaskRefusedError, UnknownTaskError
from rce_fleet.limits import MOST_TIME
from rce_fleet.tasks.loads import check_delivered, without_takeovers
from rce_fleet.tasks.order import check_cells, check_order
from rce_fleet.tasks.tables import FleetTables
from rce_fleet.tasks.task import TASK_LIFE, Task, TaskCause, TaskState

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.tasks.order import Order


CLEAR_LEAD_S = 60.0
"""With a smaller lead, the fleet's time is good enough as the time at which a recurring task began."""


class TaskBook(FleetTables):
    """The tables, and the requests that change tasks.

    Attributes:
        grid: The map, for checks of cells; None: not known yet.
        lead: By how many seconds the fleet's time is ahead of the machine's clock, which deadlines, starts
            and recurrences follow.

    Example:
        ```python
        book = TaskBook()
        task = book.create(Order((Stop(Action.GO, (42,)),)), now=0.0, user="erp", key="order-17")
        events = book.take_events()
        ```
    """

    def __init__(self) -> None:
        super().__init__()
        self.grid: GridMap | None = None
        self.lead = 0.0

    def clock_time(self, now: float) -> float:
        """Return what the machine's clock says at a moment of the fleet's time, seconds since 1970."""
        return now - self.lead

    # Requests

    def create(self, order: Order, now: float, *, user: str = "", key: str = "") -> Task:
        """Accept a task; a second request with the same key returns the first one's task.

        Of a recurring task whose first occurrence was forgotten, that is the oldest one that is known.

        Args:
            order: What is to be done.
            now: Seconds since 1970.
            user: Who asks.
            key: The requester's own key; empty: none.

        Raises:
            TaskRefusedError: It cannot be carried out.
            KeyReusedError: The key belongs to a task with another order.
        """
        if key and (known := self.with_key(user, key)) is not None:
            if known.asked != digest(order):
                raise KeyReusedError(f"the key {key!r} belongs to {known.id}, which has another content")
            return known
        check_order(order)
        check_delivered(order)
        if self.grid is not None:
            check_cells(order, self.grid)
        self._check_after(order)
        asked = digest(order) if key else ""
        start = order.earliest_start if order.earliest_start is not None else self.clock_time(now)
        recurs_at = start + order.every if order.every is not None and order.occurrences != 1 else None
        if recurs_at is not None and self.lead > CLEAR_LEAD_S:
            order = replace(order, earliest_start=start)  # deadlines of later occurrences are counted from it
        self.last_task += 1
        task = Task(self.last_task, order, user, key, now, now, recurs_at=recurs_at, asked=asked)
        self.emit(task, "created", now, user=user, text=f"{task.id} was accepted")
        return task

    def change(
        self, task_id: str, order: Order, now: float, *, user: str = "", revision: int | None = None
    ) -> Task:
        """Replace the order of a task. The stops that were made must stay as they are.

        If the task has ended and recurs, the change counts for its next occurrence.

        Raises:
            TaskRefusedError: It has ended, or a robot has already made a stop that would change.
            RevisionError: It is not at the given revision.
            UnknownTaskError: There is no such task.
        """
        task = self.at(task_id, revision)
        if task.order == order:
            return task
        if task.has_ended and task.recurs_at is not None:
            return self._change_next(task, order, task.recurs_at, now, user)
        if task.has_ended or task.state is TaskState.CANCELLING:
            raise TaskRefusedError(f"{task.id} is {task.state.value}: it cannot be changed any more")
        check_order(order)
        check_delivered(order)
        made = task.position + (task.action is not None)
        if self.grid is not None:
            check_cells(order, self.grid, made)
        self._check_after(order, task)
        if order.length < made or any(order.stop(n) != task.order.stop(n) for n in range(made)):
            raise TaskRefusedError(
                f"the first {made} stops of {task.id} were made or begun: they must stay as they are"
            )
        if task.robot and order.robot not in ("", task.robot) and task.is_bound:
            raise TaskRefusedError(f"{task.robot} has the load of {task.id}; another robot cannot take over")
        recurs_at = _recurs_at(task, order, self.clock_time(now))
        changed = replace(task, order=order, revision=task.revision + 1, recurs_at=recurs_at, late=False)
        if task.action is None and task.next_stop != changed.next_stop:
            changed = replace(changed, target=None)
        self.emit(changed, "changed", now, user=user, text=f"{task.id} was changed")
        if task.robot and order.robot not in ("", task.robot):
            text = f"{order.robot} is to do it, not {task.robot}"
            return self.advance(changed, TaskCause.RELEASE, now, text, robot="", target=None)
        return changed

    def _change_next(self, task: Task, order: Order, due: float, now: float, user: str) -> Task:
        """Replace the order of a task that has ended, for its next occurrence.

        Args:
            task: The task.
            order: Its times are those of the next occurrence, if they were changed.
            due: When the next occurrence was due before the change.
            now: Seconds since 1970.
            user: Who asks.
        """
        before = task.order
        if order.after != before.after:
            raise TaskRefusedError(f"{task.id} has ended: only its first occurrence comes after other tasks")
        recurs_at = _recurs_at(task, order, self.clock_time(now))
        if recurs_at is not None:
            if order.earliest_start not in (None, before.earliest_start):
                recurs_at = order.earliest_start
            elif order.every == before.every:
                recurs_at = due
            order = _order_at(task, order, recurs_at)
        check_order(order)
        check_delivered(order)
        if self.grid is not None:
            check_cells(order, self.grid)
        changed = replace(task, order=order, revision=task.revision + 1, recurs_at=recurs_at)
        self.emit(changed, "changed", now, user=user, text=f"{task.id} was changed for its next occurrence")
        return changed

    def hold(
        self, task_id: str, now: float, *, user: str = "", reason: str = "", revision: int | None = None
    ) -> Task:
        """Hold a task: no robot goes on with it. Holding a held task changes nothing.

        Raises:
            TaskRefusedError: It has ended, or is being cancelled.
            RevisionError: It is not at the given revision.
            UnknownTaskError: There is no such task.
        """
        task = self.at(task_id, revision)
        if task.state is TaskState.HELD:
            return task
        self._allow(task, TaskCause.HOLD)
        held = task.after(TaskCause.HOLD, now, reason or f"held by {user or 'a rule'}")
        if not task.is_bound:
            held = replace(held, robot="")
        if task.action is None:
            held = replace(held, target=None)
        self.emit(held, "held", now, user=user, text=held.reason)
        return held

    def resume(self, task_id: str, now: float, *, user: str = "", revision: int | None = None) -> Task:
        """End the hold of a task. A task that is not held is not changed.

        Raises:
            TaskRefusedError: It has ended, or is being cancelled.
            RevisionError: It is not at the given revision.
            UnknownTaskError: There is no such task.
        """
        task = self.at(task_id, revision)
        if task.has_ended or task.state is TaskState.CANCELLING:
            raise TaskRefusedError(f"{task.id} is {task.state.value}: it cannot be resumed")
        if task.state is not TaskState.HELD:
            return task
        cause = TaskCause.CONTINUE if task.is_bound else TaskCause.RESUME
        resumed = task.after(cause, now)
        self.emit(resumed, "resumed", now, user=user, text=f"{task.id} was resumed")
        return resumed

    def cancel(self, task_id: str, now: float, *, user: str = "", revision: int | None = None) -> Task:
        """Cancel a task. A robot that has its load or acts for it brings the load away first.

        If the task has ended and recurs, it stays as it is, and no occurrence follows. Cancelling a task that
        was cancelled changes nothing.

        Raises:
            TaskRefusedError: It is done or has failed.
            RevisionError: It is not at the given revision.
            UnknownTaskError: There is no such task.
        """
        task = self.at(task_id, revision)
        if task.state in (TaskState.CANCELLED, TaskState.CANCELLING):
            return task
        if task.has_ended and task.recurs_at is not None:
            by = user or "a program"
            last = replace(task, recurs_at=None, cancelled_by=by, revision=task.revision + 1)
            text = f"{by} ended the recurrence of {task.id}"
            self.emit(last, "recurrence ended", now, user=user, text=text)
            return last
        if task.has_ended and task.cancelled_by:
            return task
        if task.has_ended:
            raise TaskRefusedError(f"{task.id} is {task.state.value}: it cannot be cancelled any more")
        cause = TaskCause.RETURN if task.is_bound else TaskCause.CANCEL
        by = f"cancelled by {user or 'a rule'}"
        stop = task.next_stop if task.action is not None and not task.confirmed else None
        if stop is not None and stop.confirm and stop.moves_load:  # a person may be handling the load
            by += f"; waits for POST /tasks/{task.id}/confirm"
        ended = replace(task.after(cause, now, by), cancelled_by=user, recurs_at=None)
        if task.action is None:
            ended = replace(ended, target=None)
        self.emit(ended, ended.state.value, now, user=user, text=by)
        return ended

    def reassign(self, task_id: str, now: float, *, user: str = "", revision: int | None = None) -> Task:
        """Take a task from its robot, so that another one gets it.

        Raises:
            TaskRefusedError: No robot has it, its robot has its load or acts for it, or no other may do it.
            RevisionError: It is not at the given revision.
            UnknownTaskError: There is no such task.
        """
        task = self.at(task_id, revision)
        self._allow(task, TaskCause.RELEASE)
        if task.is_bound:
            raise TaskRefusedError(
                f"{task.robot} has the load of {task.id}, or acts for it: it has to end it"
            )
        if task.order.robot:
            raise TaskRefusedError(f"{task.id} is for {task.order.robot} only; change its robot first")
        by = f"taken from {task.robot} by {user or 'a program'}"
        released = replace(task.after(TaskCause.RELEASE, now, by), robot="", target=None)
        self.emit(released, "released", now, user=user, text=by)
        return released

    def confirm(self, task_id: str, now: float, *, user: str = "", revision: int | None = None) -> Task:
        """Confirm the action that is under way, so that it can end.

        Raises:
            TaskRefusedError: No robot acts for it.
            RevisionError: It is not at the given revision.
            UnknownTaskError: There is no such task.
        """
        task = self.at(task_id, revision)
        if task.action is None:
            raise TaskRefusedError(f"no robot acts for {task.id} now: there is nothing to confirm")
        if task.confirmed:
            return task
        confirmed = replace(task, confirmed=True, revision=task.revision + 1)
        self.emit(confirmed, "confirmed", now, user=user, text=f"{user or 'a program'} confirmed the action")
        return confirmed

    # Inner

    def advance(self, task: Task, cause: TaskCause, now: float, text: str, **changes: object) -> Task:
        """Change a task's state by a rule; note the event."""
        after = replace(task.after(cause, now, text), **changes)  # type: ignore[arg-type]  # fields of Task
        self.emit(after, cause.value, now, text=text)
        return after

    def _allow(self, task: Task, cause: TaskCause) -> None:
        if not TASK_LIFE.allows(task.state, cause):
            raise TaskRefusedError(f"{task.id} is {task.state.value}: it cannot be {cause.value}")

    def _check_after(self, order: Order, task: Task | None = None) -> None:
        """Check that the tasks before it exist, and that none of them waits for it.

        Args:
            order: What is asked for.
            task: The task that is changed; None: a new one, for which no other can wait yet.
        """
        waiting, seen = list(order.after), set[str]()
        while waiting:
            before = waiting.pop()
            if task is not None and before == task.id:
                raise TaskRefusedError(f"{task.id} would wait for itself")
            if before in seen:
                continue
            seen.add(before)
            try:
                known = self.find(before)
                waiting += known.order.after if task is not None else ()
            except UnknownTaskError as error:
                if before in order.after:
                    raise TaskRefusedError(f"the task cannot come after {before}: {error}") from error

    def recur(self, task: Task, now: float) -> Task:
        """Create the next occurrence of a recurring task; occurrences that were missed are left out."""
        every, due = task.order.every, task.recurs_at
        assert every is not None
        assert due is not None
        due += every * max(0.0, (self.clock_time(now) - due) // every)
        order = replace(_order_at(task, task.order, due), after=())
        number = task.occurrence + 1
        last = order.occurrences is not None and number >= order.occurrences
        self.emit(replace(task, recurs_at=None, revision=task.revision + 1), "recurred", now)
        self.last_task += 1
        following = Task(
            self.last_task,
            order,
            task.requester,
            task.key,
            now,
            now,
            occurrence=number,
            recurs_at=None if last else due + every,
            asked=task.asked,
        )
        self.emit(
            following, "created", now, text=f"occurrence {number} of the task that began with {task.id}"
        )
        return following


def _recurs_at(task: Task, order: Order, now: float) -> float | None:
    """Return when a task recurs after a change of its order; None: it does not."""
    every, count = order.every, order.occurrences
    if every is None or (count is not None and task.occurrence >= count):
        return None
    if every != task.order.every:
        return now + every
    if task.recurs_at is None:  # it was the last one
        return (task.created_at if order.earliest_start is None else order.earliest_start) + every
    return task.recurs_at


def _order_at(task: Task, order: Order, due: float) -> Order:
    """Return an order for a task's next occurrence, without stops that took over the load of this one.

    A deadline that was not changed moves with its start.
    """
    due, deadline = min(due, MOST_TIME), order.deadline
    if deadline is not None and deadline == task.order.deadline:
        shift = due - (task.order.earliest_start or task.created_at)
        deadline = min(deadline + shift, MOST_TIME)
    return replace(without_takeovers(order), earliest_start=due, deadline=deadline)


def digest(order: Order) -> str:
    """Return a short text that differs for orders with different contents, whatever the release."""
    given = {
        field.name: value for field in fields(order) if (value := getattr(order, field.name)) != field.default
    }
    return sha256(repr(sorted(given.items())).encode()).hexdigest()[:16]
