"""What becomes of tasks, places and goals when the planner gets another grid: its cells have other numbers.

Nothing that names a cell of the grid before is carried out; people decide what it means on the new one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rce_fleet.tasks.records import GoalEntry, Places
from rce_fleet.tasks.task import TaskCause, TaskState

if TYPE_CHECKING:
    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.task import Task

WHY = "the planner has another grid"


def leave_floor(book: TaskBook, now: float) -> None:
    """Hold all open tasks, and remove chargers, parking places, return cells and goals.

    A recurring task whose next occurrence would be created later has it now, held. A cancelled task that
    brings its load away fails: the cell to which it goes is not known any more.

    Args:
        book: The records.
        now: Seconds since 1970.
    """
    for task in list(book.tasks.values()):
        if task.has_ended and task.recurs_at is not None:
            book.recur(task, now)
    for task in list(book.open_tasks()):
        _leave(book, task, now)
    for entry in list(book.goals.values()):
        book.emit(GoalEntry(entry.id), "goal ended", now, text=f"goal of {entry.id}: {WHY}")
    if replace(book.places, revision=0) != Places():
        text = f"{WHY}: set chargers, parking places and return cells again"
        book.emit(Places(revision=book.places.revision + 1), "places", now, text=text)


def _leave(book: TaskBook, task: Task, now: float) -> None:
    if task.state is TaskState.CANCELLING:
        text = f"{WHY}; its load is on {task.robot}" if task.is_loaded else WHY
        book.advance(task, TaskCause.FAIL, now, text, target=None)
        return
    reason = f"{WHY}: give the task cells of that one, then resume it"
    if task.state is TaskState.HELD:
        held = replace(task, reason=reason, revision=task.revision + 1)
    else:
        held = task.after(TaskCause.HOLD, now, reason)
    robot = task.robot if task.is_bound else ""
    book.emit(replace(held, robot=robot, target=None), "held", now, text=reason)
