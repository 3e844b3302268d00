"""Conditions of tasks that no robot has begun: start, deadline, tasks before, recurrence."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rce_fleet.exceptions import UnknownTaskError
from rce_fleet.tasks.order import WhenLate
from rce_fleet.tasks.task import Task, TaskCause, TaskState

if TYPE_CHECKING:
    from rce_fleet.tasks.book import TaskBook

MOST_CHANGED = 200
"""Most tasks that one update changes because of their conditions; more, such as ten thousand tasks that were
made with an earliest start, have their turn in the updates after it: each change is an event."""
NOT_BEGUN = frozenset({TaskState.QUEUED, TaskState.ASSIGNED})
_FAIL_WHEN_LATE = NOT_BEGUN | {TaskState.HELD}


class Conditions:
    """Decides which tasks can begin.

    Args:
        book: The tasks.

    Attributes:
        ready: Tasks that a robot could begin with at the last update.
    """

    def __init__(self, book: TaskBook) -> None:
        self._book = book
        self.ready: list[Task] = []
        self._left = MOST_CHANGED

    def update(self, now: float) -> list[Task]:
        """Let time pass; return the tasks that a robot can begin with.

        At most :data:`MOST_CHANGED` tasks are changed. Others that should be wait for the next update, and no
        robot can begin with them meanwhile.

        Args:
            now: Seconds since 1970.
        """
        self._left = MOST_CHANGED
        self._recur(now)
        by_clock = self._book.clock_time(now)
        ready = self.ready = []
        for task in self._book.open_tasks():
            order = task.order
            if order.deadline is not None and by_clock >= order.deadline and (not task.late or _fails(task)):
                if not self._may_change():
                    continue
                task = self._pass_deadline(task, now)  # noqa: PLW2901 - the same task, changed
            if task.state is not TaskState.QUEUED and task.state is not TaskState.ASSIGNED:
                continue
            if task.position >= order.length:
                if self._may_change():
                    self._finish(task, now)
            elif (not order.after and order.earliest_start is None) or self._can_begin(task, now):
                ready.append(task)
        return ready

    def leave_changed(self) -> None:
        """Leave out of the ready tasks those that requests have changed since the last update."""
        tasks = self._book.tasks
        self.ready = [task for task in self.ready if tasks.get(task.number) is task]

    def refresh(self) -> None:
        """Take over how the manager itself has changed ready tasks; those that robots began are left out."""
        tasks = (self._book.tasks[task.number] for task in self.ready)
        self.ready = [
            task for task in tasks if task.state is TaskState.QUEUED or task.state is TaskState.ASSIGNED
        ]

    def note(self, task: Task, reason: str, now: float) -> None:
        """Note why a task waits; an event tells it if it is new."""
        if task.reason != reason:
            noted = replace(task, reason=reason, revision=task.revision + 1)
            self._book.emit(noted, "waits", now, text=f"{task.id}: {reason or 'waits for a free robot'}")

    def _may_change(self) -> bool:
        """Return whether this update may change one more task."""
        self._left -= 1
        return self._left >= 0

    def _recur(self, now: float) -> None:
        """Create occurrences that are due. One begins only after the one before has ended."""
        by_clock = self._book.clock_time(now)
        due = [
            task
            for task in self._book.recurring_tasks()
            if task.recurs_at is not None and task.has_ended and task.recurs_at <= by_clock
        ]
        for task in due:
            if not self._may_change():
                break
            self._book.recur(task, now)

    def _finish(self, task: Task, now: float) -> None:
        """End a task of which nothing is left: its last action ended while it was held, or it was changed."""
        robot = task.visits[-1].robot if task.visits else ""
        self._book.advance(task, TaskCause.FINISH, now, "all stops were made", robot=robot)

    def _pass_deadline(self, task: Task, now: float) -> Task:
        if _fails(task):
            reason = "its deadline passed before a robot began with it"
            return self._book.advance(task, TaskCause.FAIL, now, reason, robot="", late=True)
        late = replace(task, late=True, revision=task.revision + 1)
        self._book.emit(late, "late", now, text=f"the deadline of {task.id} has passed")
        return late

    def _can_begin(self, task: Task, now: float) -> bool:
        for name in task.order.after:
            try:
                before = self._book.find(name)
            except UnknownTaskError:
                continue  # It had ended long ago when an earlier release forgot it.
            if before.state in (TaskState.FAILED, TaskState.CANCELLED):
                if self._may_change():
                    reason = f"{name}, which must be done before, is {before.state.value}"
                    self._book.advance(task, TaskCause.FAIL, now, reason, robot="")
                return False
            if before.state is not TaskState.DONE:
                self._wait(task, f"waits for {name}", now)
                return False
        start = task.order.earliest_start
        if start is not None and self._book.clock_time(now) < start:
            self._wait(task, "waits for its earliest start", now)
            return False
        return True

    def _wait(self, task: Task, reason: str, now: float) -> None:
        if task.reason != reason and self._may_change():
            self.note(task, reason, now)


def _fails(task: Task) -> bool:
    """Return whether a task ends at its deadline, or later: the robot that was under way may be lost."""
    return task.order.when_late is WhenLate.FAIL and task.state in _FAIL_WHEN_LATE and not task.visits
