"""Goals for robots that nobody sends."""

from __future__ import annotations

import asyncio
from random import Random

from support.fleet_states import fleet, robot

from rce_fleet.demo.random_goals import PAUSE_AT_GOAL, RandomGoals, send_goals
from rce_fleet.station.api import FleetModel
from rce_fleet.station.client import StationClient


def test_a_robot_without_a_goal_gets_one_that_is_free() -> None:
    for seed in range(50):
        random_goals = RandomGoals(Random(seed))
        state = fleet(
            robot("a", cell=0), robot("b", cell=1, goal=2, state="driving"), blocked=[3, 4], pending=[5]
        )
        goals = random_goals.update(state, 0.0)
        assert goals.keys() == {"a"}
        assert goals["a"] not in {0, 1, 2, 3, 4, 5}


def test_two_robots_get_different_goals() -> None:
    for seed in range(50):
        goals = RandomGoals(Random(seed)).update(fleet(robot("a", cell=0), robot("b", cell=1), size=2), 0.0)
        assert sorted(goals.values()) == [2, 3]


def test_a_robot_rests_at_its_goal() -> None:
    random_goals = RandomGoals(Random(0))
    goal = random_goals.update(fleet(robot("a", cell=0)), 0.0)["a"]
    arrived = fleet(robot("a", cell=goal, goal=goal, state="arrived"))
    assert random_goals.update(arrived, 10.0) == {}
    assert random_goals.update(arrived, 10.0 + PAUSE_AT_GOAL - 0.1) == {}
    assert random_goals.update(arrived, 10.0 + PAUSE_AT_GOAL).keys() == {"a"}
    assert random_goals.taken_over == frozenset()


def test_a_driving_robot_keeps_its_goal() -> None:
    random_goals = RandomGoals(Random(0))
    goals = random_goals.update(fleet(robot("a", cell=0)), 0.0)
    assert random_goals.update(fleet(robot("a", cell=0, goal=goals["a"], state="driving")), 100.0) == {}
    assert random_goals.taken_over == frozenset()


def test_the_operator_takes_a_robot_over() -> None:
    random_goals = RandomGoals(Random(0))
    goals = random_goals.update(fleet(robot("a", cell=0), robot("b", cell=1)), 0.0)
    theirs = next(cell for cell in range(2, 16) if cell not in goals.values())
    driving = fleet(
        robot("a", cell=0, goal=theirs, state="driving"),
        robot("b", cell=1, goal=goals["b"], state="driving"),
    )
    assert random_goals.update(driving, 0.0) == {}
    assert random_goals.taken_over == {"a"}
    later = fleet(
        robot("a", cell=theirs, goal=theirs, state="arrived"),
        robot("b", cell=goals["b"], goal=goals["b"], state="arrived"),
    )
    random_goals.update(later, 1.0)
    assert random_goals.update(later, 100.0).keys() == {"b"}


def test_unreported_goal_is_sent_again_not_taken_as_operators() -> None:
    random_goals = RandomGoals(Random(0))
    first = random_goals.update(fleet(robot("a", cell=0)), 0.0)["a"]
    arrived = fleet(robot("a", cell=first, goal=first, state="arrived"))
    random_goals.update(arrived, 10.0)
    second = random_goals.update(arrived, 20.0)["a"]
    assert random_goals.update(arrived, 21.0) == {"a": second}, "the planner was away: it is told again"
    assert random_goals.update(fleet(robot("a", cell=first)), 22.0) == {"a": second}, "it was restarted"
    others = set()
    for _ in range(20):
        random_goals.on_refused("a")
        others.add(random_goals.update(arrived, 30.0)["a"])
    assert len(others) > 1, "what was refused is not tried for ever"
    assert random_goals.taken_over == frozenset()


def test_full_map_gives_no_goal() -> None:
    assert RandomGoals(Random(0)).update(fleet(robot("a", cell=0), blocked=[1, 2, 3], size=2), 0.0) == {}


class OneRobotStation(StationClient):
    """A station with one idle robot, without HTTP."""

    def __init__(self, *, has_tasks: bool) -> None:
        self._has_tasks = has_tasks
        self.goals: list[str] = []

    async def fleet(self) -> FleetModel:
        return fleet(robot("a", cell=0))

    async def has_open_tasks(self) -> bool:
        return self._has_tasks

    async def set_goal(self, robot: str, cell: int | None) -> None:
        self.goals.append(robot)


def test_no_random_goal_is_sent_while_tasks_are_open() -> None:
    """A goal that is set by hand would hold the task of its robot."""
    for has_tasks, has_manager, expected in ((True, True, []), (False, True, ["a"]), (True, False, ["a"])):
        station = OneRobotStation(has_tasks=has_tasks)
        assert asyncio.run(send_goals(station, RandomGoals(Random(0)), has_manager=has_manager)) == expected
        assert station.goals == expected


def test_goals_are_among_the_cells_that_were_given() -> None:
    chooser = RandomGoals(Random(0), [3])
    assert chooser.update(fleet(robot("a", cell=0), size=2), 0.0) == {"a": 3}
    assert RandomGoals(Random(0), [3]).update(fleet(robot("a", cell=3), size=2), 0.0) == {}
