"""Which goals are worked on."""

from __future__ import annotations

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from rce.ros.actions import GoalId
from rce.ros.actions.policy import (
    REPLACED,
    Drop,
    ManyGoals,
    Policy,
    Refuse,
    SingleGoal,
    Start,
    Step,
    Stop,
)


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


def test_goal_after_a_jump_back_of_time_starts() -> None:
    """A simulation that begins again gives goals earlier stamps."""
    policy = SingleGoal()
    policy.offer(goal(500))
    policy.ended("g500")
    policy.note_time_jump()
    assert policy.offer(goal(1)) == [Start("g1")]


def test_goal_of_before_a_jump_back_is_replaced() -> None:
    policy = SingleGoal()
    policy.offer(goal(500))
    policy.note_time_jump()
    assert policy.offer(goal(1)) == [Stop("g500")]
    assert policy.ended("g500") == [Start("g1")]


def test_cancellations_of_the_present_and_the_waiting_goal() -> None:
    policy = SingleGoal()
    policy.offer(goal(1))
    policy.offer(goal(2))
    assert policy.cancel("g2") == [Drop("g2")]
    assert policy.cancel("g1") == [Stop("g1")]
    assert policy.cancel("g0") == []
    assert policy.ended("g0") == []
    assert policy.ended("g1") == []


class Works:
    """A server that does what its policy says; each goal must come to exactly one end."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.running: list[str] = []
        self.waiting: set[str] = set()
        self.ended: list[str] = []

    def take(self, steps: Iterable[Step]) -> None:
        for step in steps:
            match step:
                case Start(goal_id):
                    self.waiting.remove(goal_id)
                    self.running.append(goal_id)
                case Stop(goal_id):
                    assert goal_id in self.running
                case Drop(goal_id) | Refuse(goal_id):
                    self.waiting.remove(goal_id)
                    self.ended.append(goal_id)

    def end_first(self) -> None:
        if self.running:
            goal_id = self.running.pop(0)
            self.ended.append(goal_id)
            self.take(self.policy.ended(goal_id))


@given(st.sampled_from([1, 3]), st.lists(st.tuples(st.sampled_from("oce"), st.integers(0, 30))))
def test_every_goal_ends_once_and_never_too_many_run(limit: int, story: list[tuple[str, int]]) -> None:
    works = Works(SingleGoal() if limit == 1 else ManyGoals(limit))
    offered: set[str] = set()
    for what, number in story:
        goal_id = f"g{number}"
        if what == "o" and goal_id not in offered:
            offered.add(goal_id)
            works.waiting.add(goal_id)
            works.take(works.policy.offer(goal(number)))
        elif what == "c" and goal_id in {*works.running, *works.waiting}:
            works.take(works.policy.cancel(goal_id))
        elif what == "e":
            works.end_first()
        assert len(works.running) <= limit
        assert len(works.waiting) <= 1
        assert works.running or not works.waiting
    while works.running:
        works.end_first()
    assert sorted(works.ended) == sorted(offered)
