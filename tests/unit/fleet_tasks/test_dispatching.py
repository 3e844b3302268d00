"""Tasks carried out by robots that move a cell a second: assignment, holds, conditions, recurrence."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import pytest

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.explaining import MOST_ROBOTS
from rce_fleet.tasks.order import Action, Order, Stop, WhenLate
from rce_fleet.tasks.records import Places, RobotEntry, RobotProfile
from rce_fleet.tasks.task import TaskState

from .conftest import Floor


def test_robots_take_the_tasks_with_the_shortest_ways(floor: Floor) -> None:
    """The nearest robot of the first task is the only near one of the second."""
    floor.add("Robot1", 0)
    floor.add("Robot2", 4)
    near_both, far = floor.go(3), floor.go(7)
    floor.run(1)
    assert (floor.task(near_both).robot, floor.task(far).robot) == ("Robot1", "Robot2")


def test_priority_age_and_deadline_come_first(floor: Floor) -> None:
    floor.add("Robot1", 0)
    floor.go(1)
    urgent = floor.go(63, priority=1)
    floor.run(1)
    assert floor.task(urgent).state is TaskState.RUNNING
    other = Floor()
    other.add("Robot1", 0)
    other.go(1)
    due = other.go(63, deadline=other.now + 60)
    other.run(1)
    assert other.task(due).state is TaskState.RUNNING


def test_a_waiting_task_says_when_it_could_be_done(floor: Floor) -> None:
    """As if a robot began it at its first stop now, or at its earliest start."""
    floor.add("Robot1", 0)
    doing = floor.go(63)
    waits = floor.deliver(8, 12, robot="Robot2")
    later = floor.go(5, robot="Robot2", earliest_start=floor.now + 500)
    floor.dispatcher.measure(floor.facts)
    floor.run(1)
    ends = [floor.dispatcher.earliest_end(floor.task(task), floor.now) for task in (doing, waits, later)]
    speed = floor.dispatcher.profile("Robot2").speed
    assert ends == [None, pytest.approx(floor.now + 4 / speed + 4), pytest.approx(floor.now - 1 + 500)]


@pytest.mark.parametrize("deadline", [-1e308, 1e308])
def test_extreme_deadlines_leave_costs_finite(floor: Floor, deadline: float) -> None:
    floor.add("Robot1", 0)
    task = floor.go(3, deadline=deadline)
    other = floor.go(5)
    floor.run_until_ended(task, other)
    assert floor.task(other).state is TaskState.DONE


def test_a_robot_that_waits_for_room_keeps_its_task(floor: Floor) -> None:
    """The planner says that a zone is full; the task is given to others when that has lasted 120 s."""
    robot = floor.add("Robot1", 0)
    task = floor.go(3)
    floor.run(1)
    floor.stuck.add("Robot1")
    for _ in range(100):
        robot.state, robot.reason = "waiting", "zone 'lift' is full"
        floor.run(1)
    assert floor.task(task).robot == "Robot1"
    floor.run(30)
    assert floor.task(task).robot == ""
    texts = [event.text for event in floor.events]
    assert any(text.endswith("s: zone 'lift' is full") for text in texts), texts


def test_many_tasks_are_done_once_each(floor: Floor) -> None:
    for number, cell in enumerate((0, 7, 56, 63), 1):
        floor.add(f"Robot{number}", cell)
    tasks = [floor.deliver(8 + number % 16, 40 + number % 8) for number in range(24)]
    floor.run_until_ended(*tasks)
    for task in map(floor.task, tasks):
        assert task.state is TaskState.DONE
        assert [visit.stop for visit in task.visits] == [0, 1]
    assigned = [event for event in floor.events if event.name == "assigned"]
    assert assigned, "no task was put into the queue of a busy robot"


def test_a_held_robot_keeps_its_load_and_continues(floor: Floor) -> None:
    robot = floor.add("Robot1", 0)
    task = floor.deliver(2, 20)
    floor.run(8)
    assert floor.task(task).loads == 1
    floor.book.hold(task.id, floor.now)
    floor.run(3)
    cell = robot.cell
    floor.run(20)
    assert (robot.cell, robot.goal, floor.task(task).robot) == (cell, None, "Robot1")
    other = floor.go(0)
    floor.run(5)
    assert floor.task(other).state is TaskState.QUEUED
    floor.book.resume(task.id, floor.now)
    floor.run_until_ended(task, other)
    assert floor.task(task).state is TaskState.DONE


def test_a_held_robot_without_load_is_free(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task, other = floor.go(63), floor.go(62)
    floor.run(2)
    running = next(each for each in (task, other) if floor.task(each).state is TaskState.RUNNING)
    waiting = task if running is other else other
    floor.book.hold(running.id, floor.now)
    floor.run_until_ended(waiting)
    assert floor.task(running).state is TaskState.HELD
    floor.book.resume(running.id, floor.now)
    floor.run_until_ended(running)


@pytest.mark.parametrize(("returns", "places", "cell"), [((33,), (), 33), ((), (34,), 34), ((), (), 2)])
def test_a_cancelled_load_is_brought_away(
    floor: Floor, returns: tuple[int, ...], places: tuple[int, ...], cell: int
) -> None:
    """It goes to the task's return cell, else of the fleet, else where it came from."""
    floor.book.emit(Places(returns=places), "places", floor.now)
    floor.add("Robot1", 0)
    task = floor.deliver(2, 63, return_cells=returns)
    floor.run(10)
    floor.book.cancel(task.id, floor.now)
    assert floor.task(task).state is TaskState.CANCELLING
    floor.run_until_ended(task)
    ended = floor.task(task)
    assert (ended.state, ended.loads) == (TaskState.CANCELLED, 0)
    assert (ended.visits[-1].stop, ended.visits[-1].cell) == (-1, cell)
    assert floor.book.task_of("Robot1") is None


def test_an_action_ends_before_a_cancelled_task_does(floor: Floor) -> None:
    floor.add("Robot1", 2)
    task = floor.deliver(2, 20, seconds=30.0)
    floor.run(5)
    floor.book.cancel(task.id, floor.now)
    floor.run_until_ended(task)
    ended = floor.task(task)
    assert [visit.stop for visit in ended.visits] == [0, -1]
    assert (ended.visits[0].ended_at or 0) - ended.visits[0].started_at >= 30.0


def test_a_task_is_taken_from_its_robot(floor: Floor) -> None:
    """Another robot does it, although the first one is nearer; a loaded robot keeps it."""
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.go(5)
    floor.run(1)
    assert floor.book.reassign(task.id, floor.now, user="anna").state is TaskState.QUEUED
    floor.dispatcher.avoid(task, "Robot1", floor.now)
    floor.run_until_ended(task)
    assert floor.task(task).robot == "Robot2"
    loaded = floor.deliver(1, 20, seconds=30.0)
    floor.run(10)
    with pytest.raises(TaskRefusedError, match=f"Robot1 has the load of {loaded.id}"):
        floor.book.reassign(loaded.id, floor.now)
    with pytest.raises(TaskRefusedError, match="is done"):
        floor.book.reassign(task.id, floor.now)


def test_two_tasks_share_a_cell_one_by_one(floor: Floor) -> None:
    floor.add("Robot1", 0)
    floor.add("Robot2", 7)
    tasks = [floor.book.create(Order((Stop(Action.GO, (20,), 10.0),)), floor.now) for _ in range(2)]
    floor.run(9)
    assert any("waits for cell 20, which" in floor.task(task).reason for task in tasks)
    floor.run_until_ended(*tasks)
    ends = sorted((visit.started_at, visit.ended_at) for task in tasks for visit in floor.task(task).visits)
    assert ends[0][1] is not None
    assert ends[1][0] >= ends[0][1]


def test_conditions_of_the_start_are_kept(floor: Floor) -> None:
    floor.add("Robot1", 0)
    later = floor.go(1, earliest_start=floor.now + 30)
    second = floor.go(2, after=(later.id,))
    floor.run(20)
    assert floor.task(later).reason == "waits for its earliest start"
    assert floor.task(second).reason == f"waits for {later.id}"
    floor.run_until_ended(second)
    assert (floor.task(second).started_at or 0) >= floor.task(later).changed_at
    assert (floor.task(later).started_at or 0) >= later.created_at + 30


def test_a_task_fails_with_the_one_before_it(floor: Floor) -> None:
    first = floor.go(1, earliest_start=floor.now + 30)
    second = floor.go(2, after=(first.id,))
    floor.book.cancel(first.id, floor.now)
    floor.run(1)
    assert floor.task(second).state is TaskState.FAILED
    assert f"{first.id}, which must be done before, is cancelled" in floor.task(second).reason


def test_deadlines_are_noted_or_end_a_task(floor: Floor) -> None:
    late = floor.go(1, deadline=floor.now + 5)
    gone = floor.go(1, deadline=floor.now + 5, when_late=WhenLate.FAIL)
    floor.run(10)
    assert (floor.task(late).late, floor.task(late).state) == (True, TaskState.QUEUED)
    assert floor.task(gone).state is TaskState.FAILED


@pytest.mark.parametrize("is_sent", [False, True])
def test_a_held_task_that_none_began_fails_at_its_deadline(floor: Floor, is_sent: bool) -> None:
    """A robot that was only on its way has not begun; a robot that holds a load keeps the task."""
    gone = floor.go(63, deadline=floor.now + 5, when_late=WhenLate.FAIL)
    rule = {"deadline": floor.now + 8, "when_late": WhenLate.FAIL}
    loaded = floor.deliver(1, 20, 1.0, priority=1, **rule)
    floor.add("Robot1", 0)
    floor.run(1)
    assert floor.task(loaded).robot == "Robot1"
    if is_sent:
        floor.add("Robot2", 40)
        floor.run(1)
        assert floor.task(gone).state is TaskState.RUNNING
    floor.book.hold(gone.id, floor.now)
    floor.run(2)
    assert floor.task(gone).state is TaskState.HELD
    floor.run(2)
    floor.book.hold(loaded.id, floor.now)
    floor.run(6)
    assert (floor.task(gone).state, floor.task(gone).late) == (TaskState.FAILED, True)
    assert "its deadline passed" in floor.task(gone).reason
    assert (floor.task(loaded).state, floor.task(loaded).late) == (TaskState.HELD, True)


def test_a_task_fails_if_its_robot_is_lost_after_the_deadline(floor: Floor) -> None:
    """The robot was under way in time; another one must not begin after the deadline."""
    task = floor.go(63, deadline=floor.now + 5, when_late=WhenLate.FAIL)
    first = floor.add("Robot1", 0)
    floor.run(8)
    assert (floor.task(task).state, floor.task(task).late) == (TaskState.RUNNING, True)
    floor.add("Robot2", 40)
    first.state, first.away_since = "silent", floor.now
    floor.run(20)
    assert (floor.task(task).state, floor.task(task).visits) == (TaskState.FAILED, ())


def test_a_task_recurs_without_piling_up(floor: Floor) -> None:
    first = floor.go(1, every=10.0, occurrences=3)
    floor.run(45)  # no robot: occurrences that are due wait
    assert len(floor.book.tasks) == 1
    floor.add("Robot1", 0)
    floor.run(60)
    tasks = sorted(floor.book.tasks.values(), key=lambda task: task.number)
    assert [task.occurrence for task in tasks] == [1, 2, 3]
    assert all(task.state is TaskState.DONE for task in tasks)
    assert floor.task(first).recurs_at is None


@pytest.mark.parametrize(
    ("given", "changed", "number", "recurs_in"),
    [
        ((10.0, 10), (10.0, 1), 1, None),
        ((10.0, 3), (10.0, 20), 3, 10.0),
        ((10.0, 3), (25.0, 3), 3, None),
        ((10.0, 3), (25.0, 4), 3, 26.0),
        ((10.0, 3), (25.0, 3), 2, 26.0),
        ((10.0, None), (10.0, None), 2, 10.0),
        ((10.0, 3), (None, None), 1, None),
        ((None, None), (10.0, 2), 1, 11.0),
    ],
)
def test_a_change_of_the_recurrence_respects_its_count(
    floor: Floor,
    given: tuple[float | None, int | None],
    changed: tuple[float | None, int | None],
    number: int,
    recurs_in: float | None,
) -> None:
    """The occurrence was created when it was due; its task is changed a second later."""
    task = floor.go(1, every=given[0], occurrences=given[1])
    while task.occurrence < number:
        floor.book.put_record(replace(task, state=TaskState.DONE))
        floor.now += 10.0
        task = floor.book.recur(floor.task(task), floor.now)
    begun = floor.now
    order = replace(task.order, every=changed[0], occurrences=changed[1], name="changed")
    task = floor.book.change(task.id, order, begun + 1.0)
    assert task.recurs_at == (None if recurs_in is None else begun + recurs_in)


@pytest.mark.parametrize(
    ("order", "reason"),
    [
        ({"payload": 80.0}, "no robot that may do it carries 80 kg: the strongest, Robot2, carries 50 kg"),
        ({"capabilities": ("fork",)}, "no robot has all of the capabilities fork"),
        ({"robot": "Robot9"}, "only Robot9 may do it, which is not in service"),
        ({}, "no path leads any robot to its stop 1 (go, cell 63)"),
        (
            {"stops": tuple(Stop(Action.GO, (cell,)) for cell in (5, 6, 63)), "return_cells": (9,)},
            "no path leads any robot to its stop 3 (go, cell 63)",
        ),
        (
            {"stops": (Stop(Action.GO, (5,)), Stop(Action.GO, (63,))), "rounds": 2},
            "no path leads any robot to its stop 2 (go, cell 63)",
        ),
        (
            {"stops": (Stop(Action.GO, (63,)),), "robot": "Robot1"},
            "no path leads Robot1 to its stop 1 (go, cell 63)",
        ),
        (
            {"stops": (Stop(Action.CHARGE),)},
            "no charger is open for its stop 'charge': set chargers, or free the cell of one",
        ),
    ],
)
def test_a_task_that_no_robot_can_do_says_why(order: dict[str, Any], reason: str) -> None:
    floor = Floor(GridMap(blocked=frozenset({54, 55, 62})))
    floor.add("Robot1", 0)
    floor.add("Robot2", 1)
    floor.book.emit(RobotEntry("Robot2", profile=RobotProfile(payload=50.0)), "profile", floor.now)
    stops = (Stop(Action.GO, (5 if order else 63,)),)
    task = floor.book.create(Order(**{"stops": stops, **order}), floor.now)
    floor.run(60)
    assert floor.task(task).reason == reason


@pytest.mark.parametrize("battery", [1.0, 0.01])
def test_empty_robots_hide_no_full_one_that_is_busy(battery: float) -> None:
    """Of many robots that fit, some are looked at to say why none can do a task."""
    floor = Floor(GridMap(10, 10))
    floor.book.emit(Places(chargers=(55,)), "places", floor.now)
    for number in range(MOST_ROBOTS):
        floor.add(f"Robot{number}", number, battery=0.01)
    full = floor.add("Robot99", 99, battery=1.0)
    floor.book.create(Order((Stop(Action.GO, (98,), 300.0),), robot="Robot99"), floor.now)
    floor.run(5)
    full.battery = battery
    tasks = [floor.go(90) for _ in range(6)]  # more than its queue takes
    floor.run(20)
    said = {floor.task(task).reason for task in tasks if floor.task(task).state is TaskState.QUEUED}
    lack = "none of the 20 fullest batteries has enough energy for it now; it waits until one has charged"
    assert said == {"" if battery == 1.0 else lack}


def test_a_task_whose_robots_cannot_be_sent_says_so(floor: Floor) -> None:
    """It waited without a reason, or the robots were said to be out of service."""
    first, second = floor.add("Robot1", 0), floor.add("Robot2", 1)
    task = floor.go(5)
    first.state, first.away_since, first.reason = "silent", floor.now, "its move client sends no reports"
    second.state = second.mode = "paused"
    second.away_since = floor.now  # else the floor moves it
    floor.run(3)
    said = "Robot1 is silent (its move client sends no reports), Robot2 is paused"
    assert floor.task(task).reason == f"no robot that could do it can be sent now: {said}"
    for robot in (first, second):
        robot.state, robot.reason, robot.cell, robot.mode = (
            "joining",
            "it is outside the map",
            None,
            "automatic",
        )
    floor.run(3)
    assert "Robot1 is joining (it is outside the map)" in floor.task(task).reason
    first.state, first.away_since, first.cell = "idle", inf, 0
    floor.run_until_ended(task)


def test_an_action_is_not_begun_again_after_a_restart(floor: Floor) -> None:
    """The manager is away during an action: it ends when its time has passed, and is there once."""
    floor.add("Robot1", 2)
    task = floor.deliver(2, 20, seconds=30.0)
    floor.run(5)
    assert floor.task(task).action is not None
    floor.restart()
    floor.now += 300
    floor.run_until_ended(task)
    assert [visit.stop for visit in floor.task(task).visits] == [0, 1]


def test_a_confirmed_stop_waits(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (1,), confirm=True),)), floor.now)
    floor.run(50)
    assert floor.task(task).action is not None
    floor.book.confirm(task.id, floor.now)
    floor.run_until_ended(task)


@pytest.mark.parametrize("action", [Action.GO, Action.PARK, Action.CHARGE])
def test_a_cancelled_task_does_not_wait_at_a_stop(floor: Floor, action: Action) -> None:
    """Neither for a person nor for the duration: no load moves there."""
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(action, (2,), 7200.0, confirm=True),)), floor.now)
    floor.run(5)
    assert floor.task(task).action is not None
    floor.book.cancel(task.id, floor.now)
    floor.run(2)
    ended = floor.task(task)
    assert (ended.state, ended.reason) == (TaskState.CANCELLED, "Robot1 has ended its action")


def test_a_cancelled_pick_says_that_it_waits_for_a_person(floor: Floor) -> None:
    """The robot must not drive on while a person hands the load over."""
    floor.add("Robot1", 0)
    stops = (Stop(Action.PICK, (2,), confirm=True), Stop(Action.DELIVER, (20,)))
    task = floor.book.create(Order(stops), floor.now)
    floor.run(5)
    assert floor.task(task).action is not None
    floor.book.cancel(task.id, floor.now, user="anna")
    floor.run(50)
    assert floor.task(task).reason == "cancelled by anna; waits for POST /tasks/T1/confirm"
    floor.book.confirm(task.id, floor.now)
    floor.run_until_ended(task, most=50)
    assert (floor.task(task).state, floor.task(task).loads) == (TaskState.CANCELLED, 0)
    assert floor.task(task).reason == "Robot1 has brought its load away"


@pytest.mark.parametrize("seconds", [0.0, 7200.0])
def test_a_cancelled_task_charges_no_further(floor: Floor, seconds: float) -> None:
    """Also at a charger that gives nothing: the robot would stand there without end."""
    floor.add("Robot1", 0, battery=0.3)
    task = floor.book.create(Order((Stop(Action.CHARGE, (2,), seconds),)), floor.now)
    floor.run(5)
    assert floor.task(task).action is not None
    floor.book.cancel(task.id, floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.CANCELLED
