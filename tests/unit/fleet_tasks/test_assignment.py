"""Which robot gets which task: the earliest end of a queue, the least sum of ways, turns of many robots."""

from __future__ import annotations

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.queueing import Queues, RobotQueue
from rce_fleet.tasks.records import RobotProfile
from rce_fleet.tasks.task import Task
from rce_fleet.tasks.travel import TravelCosts


def test_the_queue_with_the_earliest_end_gets_the_task() -> None:
    travel, grid = TravelCosts(), GridMap()
    travel.set_map(grid, frozenset(), {}, 0)
    profile = RobotProfile(speed=1.0)
    queues = [RobotQueue("Robot1", profile, 0, 50.0), RobotQueue("Robot2", profile, 63, 10.0)]
    tasks = [Task(n, Order((Stop(Action.GO, (cell,)),)), "", "", 0.0, 0.0) for n, cell in ((1, 1), (2, 62))]
    inserted = Queues(travel, 1).insert(tasks, queues)
    assert {task.number: robot for task, robot in inserted} == {1: "Robot1", 2: "Robot2"}


def test_the_sum_of_all_ways_is_the_least() -> None:
    """By hand: 3 + 1 cells; the nearest task for A first would cost 1 + 5."""
    travel, grid = TravelCosts(), GridMap(1, 10)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    robots = [FreeRobot("A", 3, RobotProfile(), None), FreeRobot("B", 5, RobotProfile(), None)]
    tasks = [Task(n, Order((Stop(Action.GO, (cell,)),)), "", "", 0.0, 0.0) for n, cell in ((1, 4), (2, 0))]
    chosen = {choice.robot: choice.task.number for choice in assigner.choose(tasks, robots, 0.0)}
    assert chosen == {"A": 2, "B": 1}


def test_hundreds_of_robots_get_tasks_in_one_call() -> None:
    """All robots get one task each, no two the same."""
    travel, grid = TravelCosts(), GridMap(20, 60)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    profile = RobotProfile()
    robots = [FreeRobot(f"R{n}", 2 * n, profile, 0.9) for n in range(600)]
    tasks = [Task(n, Order((Stop(Action.GO, (n % 100 * 12,)),)), "", "", 0.0, 0.0) for n in range(700)]
    chosen = assigner.choose(tasks, robots, 0.0, (5, 6))
    assert len({choice.robot for choice in chosen}) == len({choice.task.number for choice in chosen}) == 600


def test_robots_with_profiles_of_their_own_have_their_turns() -> None:
    """Each was compared with each task in one step: with 1000 robots that took half a minute."""
    travel, grid = TravelCosts(), GridMap(20, 60)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    robots = {
        f"R{n}": FreeRobot(f"R{n}", 2 * n, RobotProfile(capacity=60 + n, payload=n % 3), None)
        for n in range(400)
    }
    tasks = {
        n: Task(n, Order((Stop(Action.GO, (n % 100 * 12,)),), payload=1.0), "", "", 0.0, 0.0)
        for n in range(500)
    }
    turns = 0
    for turns in range(1, 20):  # noqa: B007 - their number counts
        chosen = assigner.choose([*tasks.values()], [*robots.values()], 0.0)
        assert len(chosen) <= 100
        for choice in chosen:
            del robots[choice.robot], tasks[choice.task.number]
        if all(robot.profile.payload < 1 for robot in robots.values()):
            break
    assert len(robots) == 134, "some robots that can do tasks got none"
    assert turns > 2
