"""Loads on robots that do not answer or cannot go on: people are asked where the load is."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.tasks.loads import settle_load
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import Places, RobotEntry
from rce_fleet.tasks.task import RETURN, Task, TaskState

from .conftest import Floor


@pytest.mark.parametrize("state", ["silent", "lost"])
def test_a_load_stays_with_a_silent_or_lost_robot(floor: Floor, state: str) -> None:
    first = floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.deliver(1, 20)
    floor.run(6)
    first.state, first.away_since = state, floor.now
    floor.run(60)
    waiting = floor.task(task)
    assert (waiting.state, waiting.robot) == (TaskState.SUSPENDED, "Robot1")
    assert f"its load is on Robot1: Robot1 is {state}" in waiting.reason
    assert "Where is the load that Robot1 has" in waiting.question
    first.state, first.away_since = "idle", float("inf")
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.DONE


def test_a_load_that_does_not_come_back_fails(floor: Floor) -> None:
    first = floor.add("Robot1", 0)
    task = floor.deliver(1, 20)
    floor.run(6)
    first.state, first.away_since = "silent", floor.now
    floor.run_until_ended(task, most=4000)
    assert floor.task(task).state is TaskState.FAILED
    assert floor.book.task_of("Robot1") is None


def _vanish_with_load(floor: Floor) -> Task:
    """Let a robot pick a load, and be silent from then on."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    robot.state, robot.reason, robot.away_since = "silent", "no messages", floor.now
    floor.run(20)
    assert floor.task(task).state is TaskState.SUSPENDED
    return task


def test_people_are_asked_where_a_vanished_load_is(floor: Floor) -> None:
    task = _vanish_with_load(floor)
    assert "Where is the load that Robot1 has" in floor.task(task).question
    assert [event.name for event in floor.events].count("question") == 1
    floor.add("Robot2", 63)
    settled = settle_load(floor.book, task.id, 20, floor.now, user="anna")
    assert (settled.state, settled.question) == (TaskState.QUEUED, "")
    floor.run_until_ended(task)
    ended = floor.task(task)
    assert (ended.state, ended.loads) == (TaskState.DONE, 0)
    assert [(visit.robot, visit.cell) for visit in ended.visits] == [
        *(("Robot1", 3), ("Robot2", 20), ("Robot2", 60)),
    ]


def test_an_occurrence_takes_no_former_load_over(floor: Floor) -> None:
    """The next occurrence would wait in vain at the place where the load of this one was found."""
    robot = floor.add("Robot1", 0)
    first = floor.deliver(3, 60, every=3600.0)
    while not floor.task(first).is_loaded:
        floor.run(1)
    robot.state, robot.away_since = "silent", floor.now
    floor.run(20)
    settle_load(floor.book, first.id, 20, floor.now)
    floor.add("Robot2", 63)
    floor.run_until_ended(first)
    assert [visit.cell for visit in floor.task(first).visits] == [3, 20, 60]
    following = floor.book.recur(floor.task(first), floor.now)
    assert following.order.stops == first.order.stops
    changed = floor.book.change(
        following.id, replace(following.order, stops=floor.task(first).order.stops), floor.now
    )
    assert floor.book.recur(changed, floor.now).order.stops == first.order.stops


def test_an_occurrence_keeps_a_pick_with_any_label(floor: Floor) -> None:
    """A person gave it the label of the stops that take a load over."""
    stops = (Stop(Action.PICK, (3,), label="takes the load over"), Stop(Action.DELIVER, (60,)))
    task = floor.book.create(Order(stops, every=3600.0), floor.now)
    assert floor.book.recur(task, floor.now).order.stops == stops


@pytest.mark.parametrize("is_settled", [False, True])
def test_a_change_cannot_leave_a_load_on_the_robot(floor: Floor, *, is_settled: bool) -> None:
    """The task was done then, and the robot began the next one with the load."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    if is_settled:  # the load is picked up elsewhere
        floor.book.hold(task.id, floor.now)
        settle_load(floor.book, task.id, 5, floor.now)
    order = floor.task(task).order
    with pytest.raises(TaskRefusedError, match="a load that no stop delivers: add a stop"):
        floor.book.change(task.id, replace(order, stops=order.stops[:-1]), floor.now)
    floor.book.change(task.id, replace(order, priority=2), floor.now)
    if is_settled:
        floor.book.resume(task.id, floor.now)
    floor.run_until_ended(task)
    assert (floor.task(task).loads, robot.cell) == (0, 60)


def test_a_lost_load_fails_its_task(floor: Floor) -> None:
    task = _vanish_with_load(floor)
    settle_load(floor.book, task.id, None, floor.now, user="anna")
    assert (floor.task(task).state, floor.task(task).reason) == (
        *(TaskState.FAILED, "its load is lost, says anna"),
    )
    with pytest.raises(TaskRefusedError, match="is failed"):
        settle_load(floor.book, task.id, 20, floor.now)


def test_a_found_load_ends_a_cancelled_task(floor: Floor) -> None:
    task = _vanish_with_load(floor)
    floor.book.cancel(task.id, floor.now)
    assert floor.task(task).state is TaskState.CANCELLING
    settle_load(floor.book, task.id, 20, floor.now)
    assert floor.task(task).state is TaskState.CANCELLED


def test_the_load_of_a_robot_that_drives_stays(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    floor.run(2)
    with pytest.raises(TaskRefusedError, match="T1 is running"):
        settle_load(floor.book, task.id, 20, floor.now)


@pytest.mark.parametrize("is_on_its_way", [False, True])
@pytest.mark.parametrize("answer", ["freed", "told"])
def test_a_load_without_a_path_is_asked_for_until_it_is_settled(
    floor: Floor, answer: str, *, is_on_its_way: bool
) -> None:
    """The question was there for one step; then the task ran, with a robot that stood still."""
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while floor.task(task).target != (60 if is_on_its_way else 3):
        floor.run(1)
    floor.facts.shut, floor.facts.map_revision = frozenset({60}), 1
    floor.run(60)
    events = len(floor.events)
    floor.run(300)
    assert (floor.task(task).state, floor.task(task).loads) == (TaskState.SUSPENDED, 1)
    assert "Where is the load that Robot1 has?" in floor.task(task).question
    assert len(floor.events) == events
    assert [event.name for event in floor.events].count("question") == 1
    if answer == "told":
        settle_load(floor.book, task.id, 5, floor.now)
    floor.facts.shut, floor.facts.map_revision = frozenset(), 2
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.DONE
    picked = [visit.cell for visit in floor.task(task).visits]
    assert picked == ([3, 5, 60] if answer == "told" else [3, 60])


def test_people_can_answer_for_a_load_while_its_robot_is_stuck(floor: Floor) -> None:
    """It tries again and again; they are asked once, and have time to say where the load is."""
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    floor.stuck.add("Robot1")
    states = []
    for _ in range(600):
        floor.run(1)
        states.append(floor.task(task).state)
    names = [event.name for event in floor.events]
    assert states.count(TaskState.SUSPENDED) >= 60
    assert names.count("continued") >= 3
    assert names.count("question") == 1
    while floor.task(task).state is not TaskState.SUSPENDED:
        floor.run(1)
    floor.run(5)
    settle_load(floor.book, task.id, 5, floor.now)
    floor.stuck.clear()
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.DONE


@pytest.mark.parametrize("is_cancelled", [False, True])
def test_a_dead_robot_with_a_load_keeps_no_cell(floor: Floor, *, is_cancelled: bool) -> None:
    """Others go to the cell to which it was on its way."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(3, 60, return_cells=(20,))
    while not floor.task(task).is_loaded:
        floor.run(1)
    if is_cancelled:
        floor.book.cancel(task.id, floor.now)
    floor.run(2)
    target = 20 if is_cancelled else 60
    assert floor.task(task).target == target
    robot.state, robot.away_since = "dead", floor.now
    floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    floor.add("Robot2", 63)
    other = floor.go(target)
    floor.run_until_ended(other, most=60)
    assert (floor.task(task).target, floor.task(task).loads) == (None, 1)
    events = len(floor.events)
    floor.run(5)
    assert len(floor.events) == events
    floor.book.emit(RobotEntry("Robot1"), "put in", floor.now)
    robot.state, robot.away_since = "idle", float("inf")
    floor.run_until_ended(task)
    assert floor.task(task).loads == 0


@pytest.mark.parametrize("stop", [0, 1, RETURN])
def test_a_cancelled_task_asks_for_the_load_of_a_dead_robot_at_once(floor: Floor, stop: int) -> None:
    """A robot that died while it takes a load or gives it away may have it; the task waited for two hours."""
    robot = floor.add("Robot1", 0)
    seconds = (7200.0 if stop == 0 else 1.0, 1.0 if stop == 0 else 7200.0)
    stops = (Stop(Action.PICK, (2,), seconds[0]), Stop(Action.DELIVER, (5,), seconds[1]))
    task = floor.book.create(Order(stops), floor.now)
    if stop == RETURN:
        while floor.task(task).loads == 0:
            floor.run(1)
        floor.book.cancel(task.id, floor.now)
    floor.run(15)
    assert floor.task(task).visits[-1].stop == stop
    assert floor.task(task).action is not None
    robot.state, robot.away_since = "dead", floor.now
    floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    floor.run(1)
    floor.book.cancel(task.id, floor.now)
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).action) == (TaskState.CANCELLING, None)
    assert floor.task(task).loads == 1
    settle_load(floor.book, task.id, 2, floor.now)
    assert floor.task(task).state is TaskState.CANCELLED
    assert floor.book.task_of("Robot1") is None


@pytest.mark.parametrize("state", ["silent", "unknown"])
def test_a_cancelled_pick_of_a_silent_robot_takes_its_time(floor: Floor, state: str) -> None:
    """It may be lifting the load now, and drives away with it when it is heard again."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(2, 20, 60.0)
    floor.run(5)
    assert floor.task(task).action is not None
    if state == "silent":
        robot.state, robot.away_since = state, floor.now
    else:
        del floor.facts.robots["Robot1"]
    floor.book.cancel(task.id, floor.now)
    floor.run(30)
    assert floor.task(task).action is not None
    floor.run(40)
    assert (floor.task(task).action, floor.task(task).loads) == (None, 1)


@pytest.mark.parametrize("mode", ["automatic", "out_of_service"])
def test_people_are_asked_for_a_load_taken_meanwhile(floor: Floor, mode: str) -> None:
    """The robot became silent, or was taken out, while it took the load."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(2, 20, 60.0)
    floor.run(5)
    assert floor.task(task).action is not None
    if mode == "automatic":
        robot.state, robot.reason, robot.away_since = "silent", "no messages", floor.now
    else:
        floor.book.emit(RobotEntry("Robot1", mode=mode), "taken out", floor.now)
    floor.run(30)
    suspended = floor.task(task)
    assert (suspended.state, suspended.question) == (TaskState.SUSPENDED, "")
    assert suspended.reason.startswith("Robot1 acts for it: Robot1 ")
    floor.run(60)
    asked = floor.task(task)
    assert "Where is the load that Robot1 has?" in asked.question
    assert asked.reason == suspended.reason.replace("Robot1 acts for it", "its load is on Robot1")
    (question,) = [event for event in floor.events if event.name == "question"]
    assert question.text == asked.question
    assert settle_load(floor.book, task.id, 5, floor.now).state is TaskState.QUEUED


def strand(floor: Floor, *, is_dead: bool, cancel_first: bool) -> Task:
    """Let a robot vanish with the load of a task that is cancelled, before or after that."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    floor.run(1)
    if cancel_first:
        floor.book.cancel(task.id, floor.now)
        floor.run(1)
        assert floor.task(task).question == ""
    if is_dead:
        robot.state, robot.away_since = "dead", floor.now
        floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    else:
        robot.state, robot.reason, robot.away_since = "silent", "no messages", floor.now
    floor.run(20)
    if not cancel_first:
        floor.book.cancel(task.id, floor.now)
        floor.run(1)
    return task


@pytest.mark.parametrize("cancel_first", [True, False])
@pytest.mark.parametrize("is_dead", [True, False])
def test_people_are_asked_for_the_load_of_a_cancelled_task(
    floor: Floor, *, is_dead: bool, cancel_first: bool
) -> None:
    """The task waited an hour without a word, and then failed."""
    task = strand(floor, is_dead=is_dead, cancel_first=cancel_first)
    assert floor.task(task).state is TaskState.CANCELLING
    assert "Where is the load that Robot1 has" in floor.task(task).question
    assert "its load is on Robot1" in floor.task(task).reason
    floor.run(30)
    assert [event.name for event in floor.events].count("question") == (1 if cancel_first else 2)
    assert settle_load(floor.book, task.id, 20, floor.now, user="anna").state is TaskState.CANCELLED
    assert floor.task(task).question == ""


def test_the_question_ends_when_the_robot_comes_back(floor: Floor) -> None:
    task = strand(floor, is_dead=False, cancel_first=True)
    floor.restart()
    assert floor.task(task).question != ""
    robot = floor.facts.robots["Robot1"]
    robot.state, robot.reason, robot.away_since = "idle", "", inf
    floor.run(1)
    assert floor.task(task).question == ""
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.CANCELLED


def _cancel_without_a_way(floor: Floor, *, is_on_its_way: bool = False) -> Task:
    """Cancel a task whose robot has its load, and block the only return cell before or after that."""
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60, return_cells=(40,))
    while floor.task(task).target != 60:
        floor.run(1)
    floor.run(3)
    if is_on_its_way:
        floor.book.cancel(task.id, floor.now)
        floor.run(1)
        assert floor.task(task).target == 40
    floor.facts.shut, floor.facts.map_revision = frozenset({3, 40}), 1
    if not is_on_its_way:
        floor.book.cancel(task.id, floor.now)
    return task


@pytest.mark.parametrize("is_on_its_way", [False, True])
@pytest.mark.parametrize("answer", ["freed", "told", ""])
def test_a_cancelled_load_without_a_way_is_asked_for(
    floor: Floor, answer: str, *, is_on_its_way: bool
) -> None:
    """The task waited without end, and people were not told."""
    task = _cancel_without_a_way(floor, is_on_its_way=is_on_its_way)
    floor.run(60)
    assert floor.task(task).state is TaskState.CANCELLING
    assert "Where is the load that Robot1 has" in floor.task(task).question
    assert "its load is on Robot1: " in floor.task(task).reason
    events = len(floor.events)
    floor.run(300)
    assert len(floor.events) == events
    assert [event.name for event in floor.events].count("question") == 1
    if answer == "told":
        settle_load(floor.book, task.id, 5, floor.now)
    elif answer:
        floor.facts.shut, floor.facts.map_revision = frozenset({3}), 2
    floor.run_until_ended(task, most=4000)
    ended = floor.task(task)
    assert ended.state is (TaskState.CANCELLED if answer else TaskState.FAILED)
    assert ended.visits[-1].cell == (40 if answer == "freed" else 3)
    assert floor.book.task_of("Robot1") is None


def test_people_are_asked_once_for_a_stuck_cancelled_load(floor: Floor) -> None:
    """It tries again and again, and fails after an hour."""
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    floor.run(2)
    floor.stuck.add("Robot1")
    floor.book.cancel(task.id, floor.now)
    floor.run(1000)
    names = [event.name for event in floor.events]
    assert (names.count("question"), names.count("continued") > 3) == (1, True)
    floor.run_until_ended(task, most=4000)
    assert floor.task(task).state is TaskState.FAILED


@pytest.mark.parametrize(("shut", "cell"), [((), 40), ((40,), 20), ((40, 20), 3)])
def test_a_cancelled_load_goes_where_a_way_leads(floor: Floor, shut: tuple[int, ...], cell: int) -> None:
    """To the task's return cell, else the fleet's, else where it was taken."""
    floor.book.emit(Places(returns=(20,)), "places", floor.now)
    task = floor.deliver(3, 60, return_cells=(40,))
    floor.add("Robot1", 0)
    while not floor.task(task).is_loaded:
        floor.run(1)
    floor.facts.shut, floor.facts.map_revision = frozenset(shut), 1
    floor.book.cancel(task.id, floor.now)
    floor.run_until_ended(task, most=60)
    assert (floor.task(task).state, floor.task(task).visits[-1].cell) == (TaskState.CANCELLED, cell)
