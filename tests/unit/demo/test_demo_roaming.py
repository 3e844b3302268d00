"""Goals for robots that nobody sends."""

from __future__ import annotations

from random import Random

from rce_fleet.demo.roaming import REST, Roamer
from support.fleet_states import fleet, robot


def test_a_robot_without_a_goal_gets_one_that_is_free() -> None:
    for seed in range(50):
        roamer = Roamer(Random(seed))
        state = fleet(
            robot("a", cell=0), robot("b", cell=1, goal=2, state="driving"), blocked=[3, 4], pending=[5]
        )
        goals = roamer.look(state, 0.0)
        assert goals.keys() == {"a"}
        assert goals["a"] not in {0, 1, 2, 3, 4, 5}


def test_two_robots_get_different_goals() -> None:
    for seed in range(50):
        goals = Roamer(Random(seed)).look(fleet(robot("a", cell=0), robot("b", cell=1), size=2), 0.0)
        assert sorted(goals.values()) == [2, 3]


def test_a_robot_rests_at_its_goal() -> None:
    roamer = Roamer(Random(0))
    goal = roamer.look(fleet(robot("a", cell=0)), 0.0)["a"]
    arrived = fleet(robot("a", cell=goal, goal=goal, state="arrived"))
    assert roamer.look(arrived, 10.0) == {}
    assert roamer.look(arrived, 10.0 + REST - 0.1) == {}
    assert roamer.look(arrived, 10.0 + REST).keys() == {"a"}
    assert roamer.taken_over == frozenset()


def test_a_driving_robot_keeps_its_goal() -> None:
    roamer = Roamer(Random(0))
    goals = roamer.look(fleet(robot("a", cell=0)), 0.0)
    assert roamer.look(fleet(robot("a", cell=0, goal=goals["a"], state="driving")), 100.0) == {}
    assert roamer.taken_over == frozenset()


def test_the_operator_takes_a_robot_over() -> None:
    roamer = Roamer(Random(0))
    goals = roamer.look(fleet(robot("a", cell=0), robot("b", cell=1)), 0.0)
    theirs = next(cell for cell in range(2, 16) if cell not in goals.values())
    driving = fleet(
        robot("a", cell=0, goal=theirs, state="driving"),
        robot("b", cell=1, goal=goals["b"], state="driving"),
    )
    assert roamer.look(driving, 0.0) == {}
    assert roamer.taken_over == {"a"}
    later = fleet(
        robot("a", cell=theirs, goal=theirs, state="arrived"),
        robot("b", cell=goals["b"], goal=goals["b"], state="arrived"),
    )
    roamer.look(later, 1.0)
    assert roamer.look(later, 100.0).keys() == {"b"}


def test_a_goal_that_was_not_heard_is_no_sign_of_an_operator() -> None:
    roamer = Roamer(Random(0))
    first = roamer.look(fleet(robot("a", cell=0)), 0.0)["a"]
    arrived = fleet(robot("a", cell=first, goal=first, state="arrived"))
    roamer.look(arrived, 10.0)
    second = roamer.look(arrived, 20.0)["a"]
    assert roamer.look(arrived, 21.0) == {"a": second}, "the planner was away: it is told again"
    assert roamer.look(fleet(robot("a", cell=first)), 22.0) == {"a": second}, "it was restarted"
    roamer.refused("a")
    others = {roamer.look(arrived, 30.0)["a"] for _ in range(20) if roamer.refused("a") is None}
    assert len(others) > 1, "what was refused is not tried indefinitely"
    assert roamer.taken_over == frozenset()


def test_a_full_floor_gives_no_goal() -> None:
    assert Roamer(Random(0)).look(fleet(robot("a", cell=0), blocked=[1, 2, 3], size=2), 0.0) == {}
