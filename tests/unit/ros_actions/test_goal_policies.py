"""Which goals are worked on."""

from __future__ import annotations

from rce.ros.actions import GoalId
from rce.ros.actions.policy import REPLACED, Drop, ManyGoals, Refuse, SingleGoal, Start, Stop


def goal(number: int) -> GoalId:
    return GoalId(f"g{number}", number)


def test_many_goals_up_to_a_limit() -> None:
    policy = ManyGoals(limit=2)
    assert policy.offer(goal(1)) == [Start("g1")]
    assert policy.offer(goal(2)) == [Start("g2")]
    assert policy.offer(goal(3)) == [Refuse("g3", "the server works on 2 goals already")]
    assert policy.cancel("g3") == []
    assert policy.cancel("g1") == [Stop("g1")]
    assert policy.ended("g1") == []
    assert policy.offer(goal(4)) == [Start("g4")]


def test_a_newer_goal_waits_for_the_end_of_the_one_before() -> None:
    policy = SingleGoal()
    assert policy.offer(goal(1)) == [Start("g1")]
    assert policy.offer(goal(2)) == [Stop("g1")]
    assert policy.ended("g1") == [Start("g2")]
    assert policy.ended("g2") == []


def test_only_the_newest_goal_waits() -> None:
    policy = SingleGoal()
    policy.offer(goal(1))
    policy.offer(goal(2))
    assert policy.offer(goal(4)) == [Drop("g2", REPLACED), Stop("g1")]
    assert policy.offer(goal(3)) == [Drop("g3", REPLACED)]
    assert policy.ended("g1") == [Start("g4")]


def test_an_old_goal_is_dropped_even_if_nothing_is_done() -> None:
    policy = SingleGoal()
    policy.offer(goal(2))
    policy.ended("g2")
    assert policy.offer(goal(1)) == [Drop("g1", REPLACED)]
    assert policy.offer(goal(2)) == [Start("g2")]


def test_cancellations_of_the_present_and_the_waiting_goal() -> None:
    policy = SingleGoal()
    policy.offer(goal(1))
    policy.offer(goal(2))
    assert policy.cancel("g2") == [Drop("g2")]
    assert policy.cancel("g1") == [Stop("g1")]
    assert policy.cancel("g0") == []
    assert policy.ended("g0") == []
    assert policy.ended("g1") == []
