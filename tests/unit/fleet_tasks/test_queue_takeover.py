"""Tasks in the queues of busy robots: an idle robot takes them over if it begins earlier."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotEntry, RobotProfile
from rce_fleet.tasks.task import Task, TaskState

from .conftest import Floor


def queued(way: int, **order: Any) -> tuple[Floor, Task]:
    """Return a floor where Robot1 drives ``way`` cells, and a task in its queue two cells behind that."""
    floor = Floor(GridMap(1, 200), rules=TaskRules(profile=RobotProfile(speed=1.0)))
    floor.add("Robot1", 0)
    floor.go(way)
    floor.run(1)
    task = floor.go(way + 2, **order)
    floor.run(3)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.ASSIGNED, "Robot1")
    return floor, task


def names(floor: Floor, task: Task) -> list[str]:
    return [event.name for event in floor.events if event.id == task.id]


def test_an_idle_robot_takes_a_task_that_it_begins_earlier() -> None:
    """Robot1 would be there after a hundred seconds, the robot that appears after three."""
    floor, task = queued(100)
    floor.add("Robot2", 105)
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.RUNNING, "Robot2")
    assert names(floor, task) == ["created", "assigned", "released", "started"]
    told = [event.text for event in floor.events if event.name == "released"]
    assert told == ["Robot2 takes it from the queue of Robot1"]
    floor.run_until_ended(task)
    assert [visit.robot for visit in floor.task(task).visits] == ["Robot2"]


@pytest.mark.parametrize("cell", [199, 97])
def test_a_queued_task_stays_where_it_begins_earlier(cell: int) -> None:
    """Robot1 is there in 50 s; from cell 199 it takes 147 s, from cell 97 only 5 s less."""
    floor, task = queued(50)
    robot = floor.add("Robot2", cell)
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.ASSIGNED, "Robot1")
    assert robot.goal is None
    floor.run_until_ended(task)
    assert [visit.robot for visit in floor.task(task).visits] == ["Robot1"]
    assert names(floor, task).count("assigned") == 1


def test_a_delayed_robots_queue_is_taken_over() -> None:
    """It was not worth it first; then Robot1 is stuck, so that Robot2 begins earlier after all."""
    floor, task = queued(20)
    floor.add("Robot2", 60)
    floor.run(1)
    assert floor.task(task).robot == "Robot1"
    floor.facts.robots["Robot1"].mode = "paused"
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.RUNNING, "Robot2")


@pytest.mark.parametrize(
    ("order", "battery"),
    [
        ({"robot": "Robot1"}, None),
        ({"payload": 4.0}, None),
        ({"capabilities": ("lift",)}, None),
        ({}, 0.2),
    ],
    ids=["robot", "payload", "capability", "energy"],
)
def test_a_robot_that_cannot_do_it_takes_no_task(order: dict[str, Any], battery: float | None) -> None:
    strong = RobotProfile(speed=1.0, capabilities=("lift",))
    weak = RobotProfile(speed=1.0, payload=3.0, capacity=1.0, drive=0.05, idle=0.0, acting=0.0)
    floor = Floor(GridMap(1, 200), rules=TaskRules(profile=strong))
    floor.add("Robot1", 0)
    floor.go(100)
    floor.run(1)
    task = floor.go(102, **order)
    floor.run(3)
    floor.book.emit(RobotEntry("Robot2", profile=weak), "profile", floor.now)
    floor.add("Robot2", 105, battery=battery)
    floor.run(4)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.ASSIGNED, "Robot1")


def test_a_held_task_is_not_taken_over() -> None:
    floor, task = queued(100)
    floor.book.hold(task.id, floor.now, user="operator")
    floor.add("Robot2", 105)
    floor.run(4)
    assert floor.task(task).state is TaskState.HELD


def test_urgent_tasks_for_others_do_not_hide_a_task(floor: Floor) -> None:
    """Sixty more urgent tasks need what no robot has: the idle robot gets the one that it can do."""
    floor.add("Robot1", 0)
    floor.go(63)
    floor.run(1)
    task = floor.go(10)
    floor.run(3)
    assert floor.task(task).state is TaskState.ASSIGNED
    for number in range(60):
        floor.go(number % 64, priority=5, capabilities=("lift",))
    floor.add("Robot2", 11)
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.RUNNING, "Robot2")


def test_a_refused_pair_leaves_the_robot_its_next_task() -> None:
    """The way on from the nearer of two cells is too long for the battery; the other task is short."""
    profile = RobotProfile(speed=1.0, capacity=1.0, drive=0.01, idle=0.0, acting=0.0)
    floor = Floor(GridMap(1, 100), rules=TaskRules(profile=profile))
    floor.add("Robot1", 50, battery=0.4)
    stops = (Stop(Action.GO, (90, 49)), Stop(Action.GO, (91,)))
    hard = floor.book.create(Order(stops, priority=1), floor.now)
    easy = floor.go(52)
    floor.run(1)
    assert floor.task(hard).state is not TaskState.RUNNING
    assert floor.task(easy).state is TaskState.RUNNING


def unable() -> tuple[Floor, Task]:
    """Return a floor where the battery of Robot1 is not enough for the task in its queue."""
    hungry = RobotProfile(speed=1.0, capacity=1.0, drive=0.01, idle=0.0, acting=0.0)
    floor = Floor(GridMap(1, 200), rules=TaskRules(profile=hungry))
    robot = floor.add("Robot1", 0, battery=0.95)
    floor.go(10)
    floor.run(1)
    task = floor.go(12, 60)
    floor.run(3)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.ASSIGNED, "Robot1")
    robot.battery = 0.3
    return floor, task


def test_a_full_robot_takes_what_the_idle_one_cannot_do() -> None:
    """Robot1 stands beside the first stop, and its battery is too low: Robot2 comes from far away."""
    floor, task = unable()
    floor.add("Robot2", 20, battery=1.0)
    floor.run(9)
    assert floor.book.task_of("Robot1") is None
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.RUNNING, "Robot2")


def test_a_task_in_a_queue_that_nobody_can_do_says_why() -> None:
    floor, task = unable()
    floor.run(12)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.QUEUED, "")
    assert "no robot's battery has enough energy" in floor.task(task).reason
    told = [event.text for event in floor.events if event.id == task.id and event.name == "released"]
    assert told[0].startswith("Robot1 cannot do it: its battery has 30%")


def test_a_task_for_another_robot_leaves_its_robot(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.go(40)
    floor.run(2)
    assert floor.task(task).robot == "Robot1"
    changed = floor.book.change(task.id, replace(task.order, robot="Robot2"), floor.now, user="anna")
    assert (changed.state, changed.robot, changed.target) == (TaskState.QUEUED, "", None)
    floor.add("Robot2", 63)
    floor.run_until_ended(task)
    assert [visit.robot for visit in floor.task(task).visits] == ["Robot2"]


@pytest.mark.parametrize("what", ["task", "profile"])
def test_a_robot_that_does_not_fit_any_more_loses_its_task(floor: Floor, what: str) -> None:
    floor.add("Robot1", 0)
    task = floor.go(40, payload=4.0)
    floor.run(2)
    if what == "task":
        floor.book.change(task.id, replace(task.order, capabilities=("lift",)), floor.now)
    else:
        floor.book.emit(RobotEntry("Robot1", profile=RobotProfile(payload=1.0)), "profile", floor.now)
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.QUEUED, "")


def test_a_changed_task_leaves_the_queue_of_its_robot() -> None:
    floor, task = queued(50)
    floor.book.change(task.id, replace(task.order, capabilities=("lift",)), floor.now)
    floor.run(3)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.QUEUED, "")
    assert "lift" in floor.task(task).reason
