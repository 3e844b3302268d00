"""Queued tasks get other robots if the tasks of both are done earlier so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks import batches
from rce_fleet.tasks.batches import Batch, Move
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotEntry, RobotProfile
from rce_fleet.tasks.task import Task, TaskCause, TaskState

from .conftest import Floor

REASON = "OR-Tools is missing (pip install rce[routing])"
improve = pytest.importorskip("rce_fleet.tasks.routing", reason=REASON).improve

SPEED = RobotProfile(speed=1.0)


def crossed(**order: Any) -> tuple[Floor, Task, Task]:
    """Return robots whose tasks end in cells 50 and 150, each with a task that is nearer to the other."""
    floor = Floor(GridMap(1, 200), rules=TaskRules(profile=SPEED))
    floor.add("Robot1", 0)
    floor.add("Robot2", 199)
    floor.go(50)
    floor.go(150)
    floor.run(1)
    near1, near2 = floor.go(60, **order), floor.go(140)
    for task, robot in ((near1, "Robot2"), (near2, "Robot1")):
        floor.book.advance(task, TaskCause.ASSIGN, floor.now, "by hand", robot=robot)
    return floor, near1, near2


def batch_of(floor: Floor) -> Batch:
    batch = floor.dispatcher.batch(floor.now, floor.facts)
    assert batch is not None
    return batch


def robots_of(floor: Floor, *tasks: Task) -> list[str]:
    return [floor.task(task).robot for task in tasks]


def improved(floor: Floor) -> list[Move]:
    """Look for better queues and take them over; return the moves that were found."""
    batch = batch_of(floor)
    routes = improve(batch.problem, 0.1)
    if routes is None:
        return []
    floor.dispatcher.adopt(batch, routes)
    floor.run(1)
    return batch.moves(routes)


def test_crossed_tasks_change_their_robots() -> None:
    floor, near1, near2 = crossed()
    assert sorted(improved(floor)) == [
        (near1.number, "Robot2", "Robot1"),
        (near2.number, "Robot1", "Robot2"),
    ]
    assert robots_of(floor, near1, near2) == ["Robot1", "Robot2"]
    assert {floor.task(task).state for task in (near1, near2)} == {TaskState.ASSIGNED}
    told = [event.text for event in floor.events if event.id == near1.id][-1]
    assert told == "moved from Robot2 to Robot1: the queued tasks together are done earlier"
    floor.run_until_ended(near1, near2)
    assert [floor.task(task).visits[-1].robot for task in (near1, near2)] == ["Robot1", "Robot2"]


def test_the_end_of_a_task_that_has_just_moved_is_unknown() -> None:
    """A request that waited for the journal asks for it with the task as it was before."""
    floor, near1, near2 = crossed()
    before = floor.task(near1)
    assert floor.dispatcher.expected_end(before, floor.now) == floor.now + 49.0 + 90.0
    improved(floor)
    assert floor.dispatcher.expected_end(before, floor.now) is None
    assert floor.dispatcher.expected_end(floor.task(near1), floor.now) == floor.now + 49.0 + 10.0
    assert floor.dispatcher.expected_end(floor.task(near2), floor.now) == floor.now + 48.0 + 10.0


def test_queues_that_are_as_good_as_can_be_stay() -> None:
    floor, near1, near2 = crossed()
    improved(floor)
    assert improved(floor) == []
    assert robots_of(floor, near1, near2) == ["Robot1", "Robot2"]


def test_a_batch_has_the_times_of_all_tasks_from_all_places() -> None:
    """One cell is a metre. The robots begin with their tasks now."""
    floor, near1, near2 = crossed()
    batch = batch_of(floor)
    assert batch.robots == ("Robot1", "Robot2")
    assert batch.queues == ((floor.task(near2),), (floor.task(near1),))
    problem = batch.problem
    assert problem.ready == [50.0, 49.0]
    # Rows: ends of the robots' tasks in cells 50 and 150, ends of the tasks in 140 and 60.
    assert problem.seconds == [[[90.0, 10.0], [10.0, 90.0], [0.0, 80.0], [80.0, 0.0]]]
    assert problem.queues == [[0], [1]]
    assert problem.able == [[0, 1], [0, 1]]
    assert problem.deadlines == [inf, inf]


@pytest.mark.slow
@pytest.mark.parametrize(
    "order",
    [{"robot": "Robot2"}, {"capabilities": ("lift",)}, {"payload": 9.0}],
    ids=["robot", "capabilities", "payload"],
)
def test_a_task_stays_where_the_other_robot_cannot_do_it(order: dict[str, Any]) -> None:
    floor, near1, _ = crossed(**order)
    able = replace(SPEED, capabilities=("lift",), payload=10.0)
    floor.book.emit(RobotEntry("Robot2", profile=able), "profile", floor.now)
    floor.run(1)
    improved(floor)
    assert robots_of(floor, near1) == ["Robot2"]


def test_a_task_does_not_go_to_a_robot_that_gave_it_up() -> None:
    floor, near1, _ = crossed()
    floor.dispatcher.avoid(near1, "Robot1", floor.now)
    improved(floor)
    assert robots_of(floor, near1) == ["Robot2"]


@pytest.mark.parametrize(("shut", "robot"), [((), "Robot1"), ((55,), "Robot2")])
def test_a_task_stays_where_no_way_leads_the_other_robot_to_it(shut: tuple[int, ...], robot: str) -> None:
    floor, near1, near2 = crossed()
    floor.book.cancel(near2.id, floor.now)
    floor.facts.shut, floor.facts.map_revision = frozenset(shut), 1
    improved(floor)
    assert robots_of(floor, near1) == [robot]


def test_a_robot_that_no_way_leads_to_its_tasks_is_left_out() -> None:
    floor, _, _ = crossed()
    floor.facts.shut, floor.facts.map_revision = frozenset({55}), 1
    assert floor.dispatcher.batch(floor.now, floor.facts) is None


def ends_a_task(floor: Floor, near1: Task, _near2: Task) -> None:
    floor.book.cancel(near1.id, floor.now)


def adds_a_task(floor: Floor, _near1: Task, _near2: Task) -> None:
    floor.book.advance(floor.go(100), TaskCause.ASSIGN, floor.now, "by hand", robot="Robot1")


def loses_a_robot(floor: Floor, _near1: Task, _near2: Task) -> None:
    floor.facts.robots["Robot1"].state = "silent"


def ends_the_present_task(floor: Floor, _near1: Task, _near2: Task) -> None:
    present = floor.book.task_of("Robot2")
    assert present is not None
    floor.book.cancel(present.id, floor.now)


def changes_a_task(floor: Floor, near1: Task, _near2: Task) -> None:
    floor.book.change(near1.id, replace(floor.task(near1).order, stops=(Stop(Action.GO, (190,)),)), floor.now)


def keeps_a_task(floor: Floor, near1: Task, _near2: Task) -> None:
    floor.book.change(near1.id, replace(floor.task(near1).order, robot="Robot2"), floor.now)


def pauses_a_robot(floor: Floor, _near1: Task, _near2: Task) -> None:
    floor.facts.robots["Robot1"].mode = "paused"


def shuts_a_cell(floor: Floor, _near1: Task, _near2: Task) -> None:
    floor.facts.shut, floor.facts.map_revision = frozenset({55}), 1


def makes_time_pass(floor: Floor, _near1: Task, _near2: Task) -> None:
    floor.now += 100.0


def gives_a_task_up(floor: Floor, near1: Task, _near2: Task) -> None:
    floor.dispatcher.avoid(near1, "Robot1", floor.now)


def drains_a_battery(floor: Floor, _near1: Task, _near2: Task) -> None:
    floor.facts.robots["Robot1"].battery = 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    "happens",
    [
        *(ends_a_task, adds_a_task, loses_a_robot, ends_the_present_task, changes_a_task, keeps_a_task),
        *(pauses_a_robot, shuts_a_cell, makes_time_pass, gives_a_task_up, drains_a_battery),
    ],
)
def test_better_queues_come_too_late(happens: Callable[[Floor, Task, Task], None]) -> None:
    """All moves are made, or none if something has changed."""
    floor, near1, near2 = crossed()
    batch = batch_of(floor)
    routes = improve(batch.problem, 0.1)
    assert routes == [[1], [0]]
    happens(floor, near1, near2)
    floor.dispatcher.adopt(batch, routes)
    floor.run(1)
    moved = [event for event in floor.events if "moved from" in event.text]
    assert moved == []


@pytest.mark.parametrize(
    "stop",
    [
        Stop(Action.CHARGE),
        Stop(Action.CHARGE, (20,)),
        Stop(Action.GO, (20, 30)),
        Stop(Action.GO, (20,), confirm=True),
    ],
    ids=["any charger", "charger", "cells", "confirm"],
)
@pytest.mark.parametrize("is_present", [True, False])
def test_a_task_with_an_unknown_end_leaves_its_robot_out(stop: Stop, *, is_present: bool) -> None:
    floor, _, _ = crossed()
    task = floor.book.create(Order((stop,)), floor.now)
    if is_present:
        present = floor.book.task_of("Robot1")
        assert present is not None
        floor.book.cancel(present.id, floor.now)
        floor.book.advance(task, TaskCause.START, floor.now, "by hand", robot="Robot1")
    else:
        floor.book.advance(task, TaskCause.ASSIGN, floor.now, "by hand", robot="Robot1")
    assert floor.dispatcher.batch(floor.now, floor.facts) is None


def test_a_robot_that_must_charge_soon_gets_no_tasks_of_others() -> None:
    floor, near1, near2 = crossed()
    floor.facts.robots["Robot1"].battery = 0.3
    floor.facts.robots["Robot2"].battery = 0.6
    assert batch_of(floor).problem.able == [[1], [1]]
    improved(floor)
    assert robots_of(floor, near1, near2) == ["Robot2", "Robot2"]


def test_a_task_that_takes_too_long_leaves_its_robot_out_only() -> None:
    floor, near1, near2 = crossed()
    floor.add("Robot3", 100)
    floor.go(101, robot="Robot3")
    floor.run(1)
    endless = floor.deliver(102, 103, seconds=604_800.0)
    floor.book.advance(endless, TaskCause.ASSIGN, floor.now, "by hand", robot="Robot3")
    assert sorted(batch_of(floor).robots) == ["Robot1", "Robot2"]
    improved(floor)
    assert robots_of(floor, near1, near2, endless) == ["Robot1", "Robot2", "Robot3"]


def test_few_robots_and_few_profiles_are_in_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those around one with queued tasks; each such robot has its turn."""
    monkeypatch.setattr(batches, "MOST_ROBOTS", 3)
    monkeypatch.setattr(batches, "MOST_PROFILES", 1)
    floor = Floor(GridMap(1, 200), rules=TaskRules(profile=SPEED))
    for number in range(10):
        floor.add(f"Robot{number}", 20 * number)
        floor.go(20 * number + 10, robot=f"Robot{number}")
    floor.run(1)
    for robot in ("Robot2", "Robot7"):
        floor.book.advance(floor.go(100), TaskCause.ASSIGN, floor.now, "by hand", robot=robot)
    assert [set(batch_of(floor).robots) for _ in range(3)] == [
        {"Robot1", "Robot2", "Robot3"},
        {"Robot6", "Robot7", "Robot8"},
        {"Robot1", "Robot2", "Robot3"},
    ]
    floor.book.emit(RobotEntry("Robot8", profile=replace(SPEED, speed=2.0)), "profile", floor.now)
    floor.run(1)
    assert {batch_of(floor).robots for _ in range(2)} >= {("Robot7", "Robot6")}


@pytest.mark.parametrize("robots", [0, 1, 2])
def test_fewer_than_two_robots_with_tasks_make_no_batch(robots: int) -> None:
    floor = Floor(GridMap(1, 200), rules=TaskRules(profile=SPEED))
    for number in range(robots):
        floor.add(f"Robot{number}", 20 * number)
        floor.go(100 + number)
    floor.run(1)
    if robots == 1:
        floor.go(50)
        floor.run(3)
    assert floor.dispatcher.batch(floor.now, floor.facts) is None


def test_without_a_planner_nothing_is_looked_for() -> None:
    floor, _, _ = crossed()
    floor.facts.is_live = False
    assert floor.dispatcher.batch(floor.now, floor.facts) is None
