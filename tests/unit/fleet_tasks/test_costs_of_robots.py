"""What energy and work of late add to a robot's cost of a task."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotProfile
from rce_fleet.tasks.task import Task
from rce_fleet.tasks.travel import TravelCosts
from rce_fleet.tasks.workloads import HALF_LIFE, Workloads

from .conftest import Floor

SLOW = RobotProfile(speed=1.0, capacity=1.0, drive=0.01, idle=0.0, acting=0.0)
"""A metre takes a second, and 1 % of the battery."""
LEVELS = BatteryLevels(critical=0.1)


def chosen(*robots: FreeRobot, rules: AssignmentRules | None = None, cell: int = 20) -> str:
    """Return which robot gets a task in a cell of an aisle."""
    travel, grid = TravelCosts(), GridMap(1, 41)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, rules or AssignmentRules(energy=40.0, fairness=20.0), LEVELS)
    task = Task(1, Order((Stop(Action.GO, (cell,)),)), "", "", 0.0, 0.0)
    (choice,) = assigner.choose([task], robots, 0.0)
    return choice.robot


def robot(name: str, cell: int, battery: float | None = None, worked: float = 0.0) -> FreeRobot:
    return FreeRobot(name, cell, SLOW, battery, worked)


def test_of_two_robots_the_fuller_one_is_cheaper() -> None:
    """Ten metres take a fifth of the usable energy of one, and half of that of the other."""
    assert chosen(robot("A", 10, 0.3), robot("B", 30, 0.6)) == "B"
    assert chosen(robot("A", 10, 0.6), robot("B", 30, 0.3)) == "A"


@pytest.mark.parametrize(("metres", "expected"), [(13, "B"), (20, "A")])
def test_way_and_energy_are_weighed(metres: int, expected: str) -> None:
    """A pays 10 s of way and 40 * 10 % / 30 % = 13 s; B, nearly full, 1.5 s for each metre."""
    assert chosen(robot("A", 10, 0.4), robot("B", 20 + metres, 0.9)) == expected


def test_energy_of_the_whole_task_counts() -> None:
    """Both robots stand at the first stop; the way after it takes a third of the energy of one."""
    travel, grid = TravelCosts(), GridMap(2, 41)
    travel.set_map(grid, frozenset(), {}, 0)
    task = Task(1, Order((Stop(Action.PICK, (0,)), Stop(Action.DELIVER, (20,)))), "", "", 0.0, 0.0)
    assigner = Assigner(travel, AssignmentRules(energy=40.0), LEVELS)
    robots = [robot("A", 0, 0.7), robot("B", 41, 0.9)]  # B is a metre farther away
    assert assigner.choose([task], robots, 0.0)[0].robot == "B"
    assigner = Assigner(travel, AssignmentRules(energy=0.0), LEVELS)
    assert assigner.choose([task], robots, 0.0)[0].robot == "A"


def test_unknown_battery_costs_nothing() -> None:
    assert chosen(robot("A", 10, 0.9), robot("B", 31)) == "B"


@pytest.mark.parametrize(("worked", "expected"), [(0.2, "A"), (0.3, "B")])
def test_robot_that_worked_more_is_dearer(worked: float, expected: str) -> None:
    """B is five metres farther away; 20 s are what all the time of work is worth."""
    assert chosen(robot("A", 10, worked=worked), robot("B", 35)) == expected


def test_weights_of_zero_leave_the_way_only() -> None:
    rules = AssignmentRules(energy=0.0, fairness=0.0)
    assert chosen(robot("A", 10, 0.3, 1.0), robot("B", 31, 1.0), rules=rules) == "A"


def test_work_counts_half_after_its_half_life() -> None:
    work = Workloads()
    for second in range(0, 8 * int(HALF_LIFE), 60):
        work.update(second, ("A", "B"), ("A",))
    assert work.share("A") > 0.99
    assert work.share("B") == 0
    for second in range(8 * int(HALF_LIFE), 9 * int(HALF_LIFE), 60):
        work.update(second, ("A", "B"), ())
    assert work.share("A") == pytest.approx(0.5, abs=0.01)


def test_new_robot_counts_as_the_mean_and_a_removed_one_is_forgotten() -> None:
    work = Workloads()
    for second in range(0, 600, 60):
        work.update(second, ("A", "B"), ("A",))
    work.update(600, ("A", "B", "C"), ())
    assert work.share("C") == pytest.approx((work.share("A") + work.share("B")) / 2)
    work.update(601, ("B", "C"), ())
    assert work.share("A") == 0


def test_clock_that_jumps_changes_little() -> None:
    work = Workloads()
    for now in (0.0, 60.0, 1e9, 5.0):
        work.update(now, ("A",), ("A",))
    assert 0 < work.share("A") < 0.05


def test_robots_side_by_side_share_the_tasks() -> None:
    """Without regard to work the nearer one would do all of them."""
    done = {}
    for fairness in (0.0, 2000.0):
        rules = replace(TaskRules(), assignment=AssignmentRules(fairness=fairness))
        floor = Floor(GridMap(2, 12), rules)
        floor.add("A", 0)
        floor.add("B", 12)
        tasks: list[Task] = []
        for _ in range(6):
            tasks.append(floor.go(5, 0 if len(tasks) % 2 else 1))
            floor.run_until_ended(tasks[-1])
        robots = [floor.task(task).robot for task in tasks]
        done[fairness] = {name: robots.count(name) for name in ("A", "B")}
    assert max(done[2000.0].values()) <= 4 < max(done[0.0].values())


def test_work_is_known_after_a_restart() -> None:
    """The journal has the tasks that were done: the other robot gets the next one."""
    rules = replace(TaskRules(), assignment=AssignmentRules(fairness=20_000.0))
    floor = Floor(GridMap(3, 12), rules)
    floor.add("A", 0)
    floor.add("B", 24)
    first = floor.go(11, 0)
    floor.run_until_ended(first)
    floor.restart()
    second = floor.go(5)
    floor.run(2)
    assert [floor.task(task).robot for task in (first, second)] == ["A", "B"]
