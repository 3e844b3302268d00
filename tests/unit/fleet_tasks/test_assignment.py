"""Which robot gets which task: the earliest end of a queue, the least sum of ways, turns of many robots."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot, _Group
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.queueing import MOST_SKIPPED, MOST_TASKS, Queues, RobotQueue
from rce_fleet.tasks.records import Places, RobotProfile
from rce_fleet.tasks.task import Task
from rce_fleet.tasks.travel import TravelCosts

from .conftest import Floor

AISLE = GridMap(1, 10)


def go(number: int, cell: int) -> Task:
    return Task(number, Order((Stop(Action.GO, (cell,)),)), "", "", float(number), 0.0)


def walled() -> TravelCosts:
    """Return distances in an aisle whose cells from 5 on are behind a wall."""
    travel = TravelCosts()
    travel.set_map(AISLE, frozenset({5}), {}, 0)
    return travel


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


@pytest.mark.slow
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


def test_tasks_behind_a_wall_leave_robots_to_others() -> None:
    """Sixty older ones fill the list of the most urgent; they are done first when the wall is gone."""
    travel = walled()
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    tasks = [*(go(number, 9) for number in range(60)), go(60, 1)]
    robots = [FreeRobot("A", 0, RobotProfile(), None)]
    assert [choice.task.number for choice in assigner.choose(tasks, robots, 100.0)] == [60]
    travel.set_map(AISLE, frozenset(), {}, 1)
    assert [choice.task.number for choice in assigner.choose(tasks, robots, 100.0)] == [0]


def test_each_robot_gets_a_task_on_its_side_of_a_wall() -> None:
    """Those of one side are all more urgent: the robot of the other side is not left out."""
    assigner = Assigner(walled(), AssignmentRules(), BatteryLevels())
    tasks = [*(go(number, 9) for number in range(60)), go(60, 1)]
    robots = [FreeRobot("A", 0, RobotProfile(), None), FreeRobot("B", 8, RobotProfile(speed=0.5), None)]
    chosen = {choice.robot: choice.task.number for choice in assigner.choose(tasks, robots, 100.0)}
    assert chosen == {"A": 60, "B": 0}


class CountedAssigner(Assigner):
    """Counts the tasks whose costs are computed."""

    priced = 0

    def _price(self, tasks: Sequence[Task], group: _Group, now: float, chargers: Sequence[int]) -> None:
        self.priced += len(tasks)
        super()._price(tasks, group, now, chargers)


def test_thousands_of_vain_tasks_are_passed_in_turns() -> None:
    """Each call looks at some of them, and at the most urgent ones, which may have become possible."""
    travel = walled()
    assigner = CountedAssigner(travel, AssignmentRules(), BatteryLevels())
    tasks = [*(go(number, 9) for number in range(3000)), go(3000, 1)]
    robots = [FreeRobot("A", 0, RobotProfile(), None)]
    chosen, calls = list[int](), 0
    while not chosen and calls < 10:
        calls += 1
        chosen = [choice.task.number for choice in assigner.choose(tasks, robots, 5000.0)]
    assert (chosen, calls) == ([3000], 6)
    assert assigner.priced <= calls * 551
    travel.set_map(AISLE, frozenset(), {}, 1)
    assert [choice.task.number for choice in assigner.choose(tasks, robots, 5000.0)] == [0]


def test_tasks_behind_a_wall_leave_queues_to_others() -> None:
    """In some calls, if there are many of them."""
    queues = Queues(walled())
    tasks = [*(go(number, 9) for number in range(MOST_TASKS + 2 * MOST_SKIPPED)), go(500, 1), go(501, 2)]
    inserted = [queues.insert(tasks, [RobotQueue("A", RobotProfile(), 0, 10.0)]) for _ in range(3)]
    assert [len(found) for found in inserted] == [0, 0, 2]
    assert {(task.number, robot) for task, robot in inserted[2]} == {(500, "A"), (501, "A")}


@pytest.mark.parametrize("cells", [(7, 45), (45, 7)])
@pytest.mark.parametrize("is_busy", [False, True])
def test_a_stop_with_a_cut_off_cell_is_made_in_another(
    floor: Floor, cells: tuple[int, int], *, is_busy: bool
) -> None:
    """With the cut-off cell first the task waited without end, also in a queue."""
    floor.add("Robot1", 20)
    floor.facts.shut, floor.facts.map_revision = frozenset({6, 15}), 1
    if is_busy:
        floor.book.create(Order((Stop(Action.GO, (21,), 20.0),)), floor.now)
        floor.run(3)
    task = floor.book.create(Order((Stop(Action.PICK, cells), Stop(Action.DELIVER, (40,)))), floor.now)
    floor.dispatcher.measure(floor.facts)
    assert floor.dispatcher.earliest_end(task, floor.now) == pytest.approx(floor.now + 5 / 0.4)
    floor.run_until_ended(task, most=100)
    assert [visit.cell for visit in floor.task(task).visits] == [45, 40]


@pytest.mark.parametrize("cells", [(0, 398), (398, 0)])
@pytest.mark.parametrize("is_last", [False, True])
def test_a_far_cell_of_a_stop_takes_no_energy_of_a_near_one(cells: tuple[int, int], *, is_last: bool) -> None:
    floor = Floor(GridMap(20, 20), TaskRules(profile=RobotProfile(capacity=1.0, drive=0.012, idle=0.0)))
    floor.book.emit(Places(chargers=(379,)), "places", floor.now)
    floor.add("Robot1", 397, battery=0.3)
    stops = (Stop(Action.PICK, cells), Stop(Action.DELIVER, (399,)))
    task = floor.book.create(Order((Stop(Action.GO, cells),) if is_last else stops), floor.now)
    floor.run_until_ended(task, most=60)
    assert floor.task(task).visits[0].cell == 398


def test_a_robot_without_battery_needs_no_way_to_a_charger(floor: Floor) -> None:
    floor.book.emit(Places(chargers=(7,)), "places", floor.now)
    floor.add("Robot1", 20)
    floor.facts.shut, floor.facts.map_revision = frozenset({6, 15}), 1
    task = floor.book.create(Order((Stop(Action.GO, (45, 46)),)), floor.now)
    floor.run_until_ended(task, most=60)


def test_a_first_stop_without_cells_asks_each_robot(floor: Floor) -> None:
    """The first robot of the profile is cut off from the second stop, the other one is not."""
    floor.add("Robot1", 7)
    floor.add("Robot2", 20)
    floor.facts.shut, floor.facts.map_revision = frozenset({6, 15}), 1
    task = floor.book.create(Order((Stop(Action.PARK), Stop(Action.GO, (40,)))), floor.now)
    floor.run_until_ended(task, most=100)
    assert floor.task(task).robot == "Robot2"
