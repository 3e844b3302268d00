"""A cancelled task whose load is on a robot that does not answer: people are asked where the load is."""

from __future__ import annotations

from math import inf
from typing import Any

import pytest

from rce_fleet.tasks.loads import settle_load
from rce_fleet.tasks.records import RobotEntry
from rce_fleet.tasks.task import Task, TaskState


def strand(floor: Any, *, is_dead: bool, cancel_first: bool) -> Task:
    """Let a robot vanish with the load of a task that is cancelled, before or after that."""
    robot = floor.add("Robot1", 0)
    task: Task = floor.deliver(3, 60)
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
    floor: Any, *, is_dead: bool, cancel_first: bool
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


def test_the_question_ends_when_the_robot_comes_back(floor: Any) -> None:
    task = strand(floor, is_dead=False, cancel_first=True)
    floor.restart()
    assert floor.task(task).question != ""
    robot = floor.facts.robots["Robot1"]
    robot.state, robot.reason, robot.away_since = "idle", "", inf
    floor.run(1)
    assert floor.task(task).question == ""
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.CANCELLED
