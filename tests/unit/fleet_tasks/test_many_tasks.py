"""Ten thousand tasks at once: what one part of a step does is bounded, and requests between parts count."""

from __future__ import annotations

import logging
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest
from support.fleet_manager import Planner

from rce_fleet.journal.journal import Journal
from rce_fleet.manager.manager import FleetManager
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks import dispatch, explaining
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, misfit
from rce_fleet.tasks.conditions import MOST_CHANGED, Conditions
from rce_fleet.tasks.dispatch import MOST_EXPLAINED, TaskRules
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.explaining import MOST_ROBOTS
from rce_fleet.tasks.order import Action, Order, Stop, WhenLate
from rce_fleet.tasks.queueing import MOST_QUEUES, MOST_TASKS, NEAREST, Queues, RobotQueue
from rce_fleet.tasks.records import RobotProfile
from rce_fleet.tasks.task import Task, TaskState
from rce_fleet.tasks.travel import TravelCosts
from rce_fleet.tasks.urgency import most_urgent_first, urgencies

from .conftest import Floor

LOADING = """
import asyncio, logging, pathlib, sys, threading
from importlib.abc import MetaPathFinder

loaded = {}


class Watch(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in ("scipy.optimize", "scipy.sparse.csgraph"):
            loaded[name] = threading.current_thread() is threading.main_thread()


from rce_fleet.journal.journal import Journal
from rce_fleet.manager.manager import FleetManager
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop


async def main():
    sys.meta_path.insert(0, Watch())
    manager = FleetManager(Journal(pathlib.Path(sys.argv[1])), None, TaskRules(), logging.getLogger())
    manager.facts.grid, manager.facts.is_live = GridMap(), True
    manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    manager.book.create(Order((Stop(Action.GO, (5,)),)), 0.0)
    manager.tell_planner = lambda: asyncio.sleep(0, {})
    manager.goals.to_send = lambda *_: []
    await manager.step()
    print(manager.book.task_of("Robot1").id, sorted(loaded.items()))
    await manager.close()


asyncio.run(main())
"""


def test_conditions_change_a_bounded_number_of_tasks(floor: Floor) -> None:
    """Each gets its reason in one of the updates."""
    tasks = [floor.go(5, earliest_start=floor.now + 100) for _ in range(2 * MOST_CHANGED + 10)]
    floor.book.take_events()
    conditions, noted = Conditions(floor.book), []
    for _ in range(4):
        assert conditions.update(floor.now) == []
        noted.append(len(floor.book.take_events()))
    assert noted == [MOST_CHANGED, MOST_CHANGED, 10, 0]
    assert {floor.task(task).reason for task in tasks} == {"waits for its earliest start"}


def test_a_task_that_must_fail_does_not_begin(floor: Floor) -> None:
    """Not even while so many others fail that its turn comes later."""
    late = {"deadline": floor.now + 1, "when_late": WhenLate.FAIL}
    tasks = [floor.go(5, **late) for _ in range(MOST_CHANGED + 10)]
    floor.add("Robot1", 0)
    floor.run(1)
    assert [floor.task(task).state for task in tasks[-10:]] == [TaskState.QUEUED] * 10
    floor.run(1)
    assert {floor.task(task).state for task in tasks} == {TaskState.FAILED}


def test_recurring_tasks_that_are_due_together_recur_bit_by_bit(floor: Floor) -> None:
    tasks = [floor.go(5, every=1000.0) for _ in range(MOST_CHANGED + 10)]
    for task in tasks:
        floor.book.cancel(task.id, floor.now)
        floor.book.put_record(replace(floor.task(task), recurs_at=floor.now))
    conditions = Conditions(floor.book)
    assert len(conditions.update(floor.now)) == MOST_CHANGED
    assert len(conditions.update(floor.now)) == MOST_CHANGED + 10


def test_urgencies_of_many_tasks_are_those_of_each() -> None:
    random, rules = Random(5), AssignmentRules()
    assigner = Assigner(TravelCosts(), rules, BatteryLevels())
    tasks = [
        Task(
            number,
            Order(
                (Stop(Action.GO, (1,)),),
                priority=random.randint(-2, 2),
                earliest_start=random.choice([None, 900.0, 1e11]),
                deadline=random.choice([None, 1000.0, 1100.0, 1e308, -1e308]),
            ),
            "",
            "",
            random.choice([0.0, 950.0, 1050.0]),
            0.0,
        )
        for number in range(300)
    ]
    random.shuffle(tasks)
    assert urgencies(tasks, 1000.0, rules).tolist() == [assigner.urgency(task, 1000.0) for task in tasks]
    in_turn = sorted(tasks, key=lambda task: (-assigner.urgency(task, 1000.0), task.number))
    assert most_urgent_first(tasks, 1000.0, rules) == in_turn
    assert most_urgent_first([], 1000.0, rules) == []


def test_a_task_cancelled_between_two_parts_does_not_begin(floor: Floor) -> None:
    floor.add("Robot1", 0)
    cancelled, later, other = floor.go(1), floor.go(1), floor.go(60)
    parts = floor.dispatcher.parts(floor.now, floor.facts)
    next(parts)
    next(parts)  # both could begin now
    floor.book.cancel(cancelled.id, floor.now)
    floor.book.change(later.id, replace(later.order, earliest_start=floor.now + 100), floor.now)
    for _ in parts:
        pass
    states = [floor.task(task).state for task in (cancelled, later, other)]
    assert states == [TaskState.CANCELLED, TaskState.QUEUED, TaskState.RUNNING]


def test_a_task_changed_before_queues_are_filled_waits(floor: Floor) -> None:
    floor.add("Robot1", 0)
    first, changed, other = floor.go(1), floor.go(2), floor.go(3)
    parts = floor.dispatcher.parts(floor.now, floor.facts)
    for _ in range(3):
        next(parts)
    assert floor.task(first).state is TaskState.RUNNING
    floor.book.change(changed.id, replace(changed.order, earliest_start=floor.now + 100), floor.now)
    for _ in parts:
        pass
    assert [floor.task(task).state for task in (changed, other)] == [TaskState.QUEUED, TaskState.ASSIGNED]


def test_a_planner_that_falls_silent_between_parts_stops_them(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.go(1)
    parts = floor.dispatcher.parts(floor.now, floor.facts)
    next(parts)
    floor.facts.is_live = False
    assert list(parts) == [None]
    assert floor.task(task).state is TaskState.QUEUED


class CountedQueues(Queues):
    """Counts how often the end of a queue is computed."""

    finished = 0

    def finish(self, queue: RobotQueue) -> float:
        self.finished += 1
        return super().finish(queue)


def test_inserting_computes_only_queues_that_changed() -> None:
    """Not all of the nearest queues of each task that shares one with the task inserted last."""
    grid, random = GridMap(20, 20), Random(3)
    travel = TravelCosts()
    travel.set_map(grid, frozenset(), {}, 0)
    profile, queues = RobotProfile(), CountedQueues(travel)
    tasks = [
        Task(number, Order((Stop(Action.GO, (random.randrange(400),)),)), "", "", 0.0, 0.0)
        for number in range(MOST_TASKS)
    ]
    robots = [
        RobotQueue(f"R{number}", profile, random.randrange(400), 0.0) for number in range(2 * MOST_QUEUES)
    ]
    inserted = queues.insert(tasks, robots)
    assert len(inserted) == MOST_TASKS
    each_once = MOST_TASKS * NEAREST
    assert each_once <= queues.finished <= 3 * each_once


def test_reasons_look_at_few_of_the_robots(floor: Floor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a thousand robots that could do a task, a reason that it has none needs the first ones."""
    looked: list[str] = []

    def counted(task: Task, robot: str, profile: RobotProfile) -> str:
        looked.append(robot)
        return misfit(task, robot, profile)

    for number in range(200):
        floor.add(f"Robot{number}", number % 64)
    for number in range(200 + 2 * MOST_EXPLAINED):
        floor.go(number % 64, number * 7 % 64)
    floor.dispatcher.rules = replace(floor.dispatcher.rules, queue_length=0)
    monkeypatch.setattr(explaining, "misfit", counted)
    monkeypatch.setattr(dispatch, "misfit", counted)
    parts = floor.dispatcher.parts(floor.now, floor.facts)
    for _ in range(4):
        next(parts)
    looked.clear()
    assert list(parts) == []
    assert 0 < len(looked) <= MOST_EXPLAINED * (MOST_ROBOTS + 1)


async def test_events_of_a_large_batch_are_published_in_slices(tmp_path: Path) -> None:
    published: list[list[dict[str, Any]]] = []
    manager = FleetManager(
        *(Journal(tmp_path / "j.sqlite"), Planner(), TaskRules(), logging.getLogger("manager")),
        publish=published.append,
    )
    for _ in range(250):
        manager.book.create(Order((Stop(Action.GO, (5,)),)), 0.0)
    await manager.commit()
    await manager.close()
    assert [len(events) for events in published] == [100, 100, 50]
    assert [event["number"] for events in published for event in events] == list(range(1, 251))


@pytest.mark.slow
def test_libraries_are_not_loaded_in_the_event_loop(tmp_path: Path) -> None:
    """scipy takes more than a second to load; a thread does it before the first task is given."""
    command = [sys.executable, "-c", LOADING, str(tmp_path / "j.sqlite")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == f"T1 {[('scipy.optimize', False), ('scipy.sparse.csgraph', False)]}"
