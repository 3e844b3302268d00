"""Restarts, holds, cancellations, lost robots, blocked cells, steps of the clock: no task is lost."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rce_fleet.tasks.loads import settle_load
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.task import Task, TaskState

from .conftest import Floor

NAMES = ("Robot1", "Robot2", "Robot3")


class Shift:
    """A floor on which things happen at random."""

    def __init__(self) -> None:
        self.floor = Floor()
        self.tasks: list[Task] = []
        self.cancelled: set[str] = set()
        """The tasks that a person cancelled."""
        for name, cell in zip(NAMES, (0, 7, 56), strict=True):
            self.floor.add(name, cell)

    def happen(self, what: str, first: int, second: int) -> None:
        """Let one thing happen, with two numbers that say where or to whom."""
        floor = self.floor
        still_open = [task for task in self.tasks if not floor.task(task).has_ended]
        if what == "post":
            self.tasks.append(floor.deliver(8 + first, 32 + second))
        elif what == "restart":
            floor.restart()
        elif what == "lose":
            robot = floor.facts.robots[NAMES[first % len(NAMES)]]
            is_away = robot.state == "silent"
            robot.state = "idle" if is_away else "silent"
            robot.away_since = float("inf") if is_away else floor.now
        elif what == "block":
            self.block(8 + first + second)
        elif what == "clock":
            step = 600.0 * (1 + first)
            floor.now += step
            floor.facts.skip(step, floor.now)
        elif still_open:
            task = floor.task(still_open[first % len(still_open)])
            if task.state is not TaskState.CANCELLING:
                getattr(floor.book, what)(task.id, floor.now)
                if what == "cancel":
                    self.cancelled.add(task.id)

    def block(self, *cells: int) -> None:
        self.floor.facts.shut = frozenset(cells)
        self.floor.facts.map_revision += 1

    def end(self) -> None:
        """Let everything work again, until all tasks have ended."""
        self.floor.restart()
        self.block()
        for robot in self.floor.facts.robots.values():
            robot.state, robot.away_since = "idle", float("inf")
        for task in self.tasks:
            if self.floor.task(task).state is TaskState.HELD:
                self.floor.book.resume(task.id, self.floor.now)
        self.floor.run_until_ended(*self.tasks, most=4000)


_THINGS = st.tuples(
    st.sampled_from(["post", "post", "hold", "resume", "cancel", "restart", "lose", "block", "clock"]),
    st.integers(0, 22),
    st.integers(0, 22),
    st.integers(1, 40),
)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.lists(_THINGS, min_size=5, max_size=25))
@example([("post", 0, 0, 5), ("hold", 0, 0, 5), ("restart", 0, 0, 5)])
def test_no_task_is_lost_or_done_twice(things: list[tuple[str, int, int, int]]) -> None:
    """Restarts, holds, cancellations, silence, blocked cells and steps of the clock at random moments."""
    shift = Shift()
    for what, first, second, seconds in things:
        shift.happen(what, first, second)
        shift.floor.run(seconds)
    shift.end()
    for task in map(shift.floor.task, shift.tasks):
        is_cancelled = task.state is TaskState.CANCELLED and task.id in shift.cancelled
        assert task.state is TaskState.DONE or is_cancelled, task
        assert task.loads == 0
        assert task.reason, "each end has a reason"
        stops = [visit.stop for visit in task.visits]
        assert is_cancelled or stops == [0, 1]
        assert len(set(stops)) == len(stops)
        assert all(visit.ended_at is not None for visit in task.visits)
    assert all(shift.floor.book.task_of(name) is None for name in NAMES)


_LOSSES = st.tuples(
    st.sampled_from(["post", "go", "charge", "hold", "resume", "cancel", "restart", "lose", "kill", "block"]),
    st.integers(0, 22),
    st.integers(0, 22),
    st.integers(1, 40),
)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.lists(_LOSSES, min_size=5, max_size=25))
def test_people_can_end_each_task_whatever_happened(things: list[tuple[str, int, int, int]]) -> None:
    """At the end all robots are dead; tasks are cancelled, and their loads are said to be lost."""
    shift = Shift()
    floor = shift.floor
    for what, first, second, seconds in things:
        if what == "go":
            stop = Stop(Action.GO, (8 + first,), 300.0, confirm=second > 11)
            shift.tasks.append(floor.book.create(Order((stop,)), floor.now))
        elif what == "charge":
            shift.tasks.append(floor.book.create(Order((Stop(Action.CHARGE, (8 + first,)),)), floor.now))
        elif what == "kill":
            floor.let_die(floor.facts.robots[NAMES[first % len(NAMES)]])
        else:
            shift.happen(what, first, second)
        floor.run(seconds)
    for name in NAMES:
        floor.let_die(floor.facts.robots[name])
    floor.run(5)
    for task in map(floor.task, shift.tasks):
        if not task.has_ended:
            floor.book.cancel(task.id, floor.now)
    floor.run(5)
    for task in map(floor.task, shift.tasks):
        if task.is_loaded and not task.has_ended and task.action is None:
            settle_load(floor.book, task.id, None, floor.now)
    floor.run(1)
    assert all(floor.task(task).has_ended and floor.task(task).reason for task in shift.tasks)
    assert all(floor.book.task_of(name) is None for name in NAMES)
    assert floor.dispatcher.goals() == dict.fromkeys(NAMES)
