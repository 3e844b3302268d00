"""Tasks whose robot is silent, stuck, halted, dead or taken out, and has no load of them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotEntry
from rce_fleet.tasks.task import Task, TaskState

from .conftest import Floor


@pytest.mark.parametrize("state", ["silent", "lost"])
def test_a_silent_or_lost_robots_task_goes_to_another(floor: Floor, state: str) -> None:
    first = floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.go(5, 6)
    floor.run(2)
    first.state, first.reason, first.away_since = state, "its pose is uncertain", floor.now
    floor.run(10)
    assert floor.task(task).robot == "Robot1"
    floor.run_until_ended(task)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.DONE, "Robot2")
    assert f"Robot1 is {state}: its pose is uncertain" in [event.text for event in floor.events]


def test_a_stuck_robots_task_goes_to_another(floor: Floor) -> None:
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    floor.stuck = {"Robot1"}
    task = floor.go(5)
    floor.run_until_ended(task)
    assert floor.task(task).robot == "Robot2"
    assert any("has not left cell 0" in event.text for event in floor.events)


@pytest.mark.parametrize("is_loaded", [False, True])
def test_a_robot_that_acted_long_is_not_stuck(floor: Floor, is_loaded: bool) -> None:
    """It has stood still in the cell of a stop, longer than a robot may that shall drive."""
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    long = Stop(Action.PICK if is_loaded else Action.GO, (3,), duration=150.0)
    last = Stop(Action.DELIVER if is_loaded else Action.GO, (60,))
    task = floor.book.create(Order((long, last)), floor.now)
    floor.run_until_ended(task)
    assert {visit.robot for visit in floor.task(task).visits} == {"Robot1"}
    assert not any("has not left" in event.text for event in floor.events)


def test_a_robot_that_waited_for_its_cell_is_not_stuck(floor: Floor) -> None:
    floor.add("Robot1", 0)
    first = floor.add("Robot2", 63)
    long = floor.book.create(Order((Stop(Action.GO, (61,), duration=200.0),), robot="Robot2"), floor.now)
    floor.run(5)
    assert first.cell == 61
    task = floor.book.create(Order((Stop(Action.GO, (61,)),), robot="Robot1"), floor.now)
    floor.run_until_ended(long)
    floor.book.emit(RobotEntry("Robot2", mode="out_of_service"), "taken out", floor.now)
    del floor.facts.robots["Robot2"]
    floor.run_until_ended(task)
    assert not any("has not left" in event.text for event in floor.events)


@pytest.mark.parametrize("mode", ["dead", "out_of_service"])
def test_a_robot_taken_out_gives_its_task_away(floor: Floor, mode: str) -> None:
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.go(5)
    floor.run(1)
    floor.book.emit(RobotEntry("Robot1", mode=mode), "taken out", floor.now)
    floor.run(2)
    assert floor.task(task).robot == "Robot2"
    assert floor.dispatcher.goals()["Robot1"] is None


@pytest.mark.parametrize("state", ["paused", "stopped", "manual"])
def test_a_halted_robot_keeps_its_task(floor: Floor, state: str) -> None:
    """However long; and no halted robot begins with another one."""
    first, second = floor.add("Robot1", 0), floor.add("Robot2", 63)
    task = floor.go(5)
    floor.run(2)
    for robot in (first, second):
        robot.state, robot.away_since = state, floor.now  # away, so that the floor does not move it
    other = floor.go(20)
    floor.run(400)
    assert (floor.task(task).robot, floor.task(task).state) == ("Robot1", TaskState.RUNNING)
    assert floor.task(other).state in (TaskState.QUEUED, TaskState.ASSIGNED)


def test_a_robot_taken_out_ends_its_action(floor: Floor) -> None:
    """Its task has nothing left then."""
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (2,), 30.0),)), floor.now)
    floor.run(5)
    floor.book.emit(RobotEntry("Robot1", mode="out_of_service"), "taken out", floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.SUSPENDED
    floor.run_until_ended(task, most=60)
    assert floor.task(task).state is TaskState.DONE


def _vanish_acting(floor: Floor) -> Task:
    """Let a robot act at the only stop for half a minute, and be silent from then on."""
    robot = floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (2,), 30.0),)), floor.now)
    while floor.task(task).action is None:
        floor.run(1)
    robot.state, robot.reason, robot.away_since = "silent", "no messages", floor.now
    floor.run(20)
    assert floor.task(task).state is TaskState.SUSPENDED
    return task


def test_a_last_action_ends_while_its_robot_is_away(floor: Floor) -> None:
    """All stops were made: the task is done, and the robot has none."""
    task = _vanish_acting(floor)
    assert floor.task(task).reason == "Robot1 acts for it: Robot1 is silent: no messages"
    floor.run_until_ended(task, most=20)
    assert floor.task(task).state is TaskState.DONE
    assert floor.book.task_of("Robot1") is None


def test_an_action_that_ends_while_away_frees_the_task(floor: Floor) -> None:
    """Another robot makes the stops that are left."""
    robot = floor.add("Robot1", 0)
    stops = (Stop(Action.GO, (2,), 30.0), Stop(Action.GO, (5,)))
    task = floor.book.create(Order(stops), floor.now)
    while floor.task(task).action is None:
        floor.run(1)
    robot.state, robot.away_since = "silent", floor.now
    floor.add("Robot2", 63)
    floor.run_until_ended(task, most=120)
    assert floor.task(task).state is TaskState.DONE
    assert [visit.robot for visit in floor.task(task).visits] == ["Robot1", "Robot2"]


def test_a_suspended_task_can_be_cancelled_in_each_moment(floor: Floor) -> None:
    """Also between the end of its action and the next step."""
    task = _vanish_acting(floor)
    visit = floor.task(task).visits[-1]
    ended = replace(floor.task(task), visits=(replace(visit, ended_at=floor.now),), position=1)
    floor.book.put_record(ended)
    assert floor.book.cancel(task.id, floor.now).state is TaskState.CANCELLED
    assert floor.book.task_of("Robot1") is None


@pytest.mark.parametrize("how", ["held", "changed"])
def test_a_task_whose_stops_were_all_made_is_done(floor: Floor, how: str) -> None:
    """No robot has to begin with it to find out that nothing is left."""
    robot = floor.add("Robot1", 0)
    stops = (Stop(Action.GO, (2,), 10.0), Stop(Action.GO, (5,)))
    task = floor.book.create(Order(stops[:1] if how == "held" else stops), floor.now)
    floor.run(5)
    floor.book.hold(task.id, floor.now)
    floor.run(20)
    robot.state, robot.away_since = "silent", floor.now
    if how == "changed":
        floor.book.change(task.id, Order(stops[:1]), floor.now)
    floor.book.resume(task.id, floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.DONE


@pytest.mark.parametrize("action", [Action.GO, Action.PARK, Action.CHARGE])
def test_a_cancelled_task_ends_with_a_dead_robot(floor: Floor, action: Action) -> None:
    """It has no load, and the robot does nothing at the stop whose end would count."""
    robot = floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(action, (2,), 7200.0, confirm=True),)), floor.now)
    floor.run(5)
    robot.state, robot.away_since = "dead", floor.now
    floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.SUSPENDED
    floor.book.cancel(task.id, floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.CANCELLED
    assert floor.book.task_of("Robot1") is None


@pytest.mark.parametrize("state", [TaskState.CANCELLED, TaskState.DONE])
def test_a_task_of_which_nothing_is_left_needs_no_planner(floor: Floor, state: TaskState) -> None:
    """Its last action ends while the planner is away, with all robots."""
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (2,), 30.0),)), floor.now)
    floor.run(5)
    floor.facts.is_live = False
    floor.facts.robots.clear()
    if state is TaskState.CANCELLED:
        floor.book.cancel(task.id, floor.now)
    floor.run(40)
    assert floor.task(task).state is state


@pytest.mark.parametrize(("is_shut", "still"), [(False, 110), (True, 15)])
def test_a_silent_planner_costs_no_robot_its_task(floor: Floor, is_shut: bool, still: int) -> None:
    """How long robots stand still counts from when the planner is heard again."""
    floor.add("Robot1", 0)
    floor.stuck = {"Robot1"}
    task = floor.go(5)
    floor.run(5)
    if is_shut:
        floor.facts.shut, floor.facts.map_revision = frozenset({5}), 1
    floor.facts.is_live = False
    floor.run(300)
    assert floor.task(task).robot == "Robot1"
    floor.facts.is_live = True
    floor.run(still)
    assert floor.task(task).robot == "Robot1"
    floor.run(20)
    assert any(event.name == "released" for event in floor.events)


def test_a_silent_planner_raises_no_question(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.deliver(1, 5)
    floor.run(5)
    floor.stuck = {"Robot1"}
    floor.facts.is_live = False
    floor.run(300)
    assert (floor.task(task).is_loaded, floor.task(task).state) == (True, TaskState.RUNNING)
    assert not any(event.name == "question" for event in floor.events)
