"""Goals and cancellations as actionlib's server takes them."""

from __future__ import annotations

import pytest

from rce_fleet.coordination.move_client import GoalState
from rce_fleet.simulation.goal_list import GoalList


@pytest.mark.parametrize(
    ("goal_id", "stamp", "is_cancelled"),
    [
        ("goal", 0.0, True),
        ("other", 0.0, False),
        ("", 0.0, True),
        ("", 1.0, True),
        ("other", 1.0, True),
    ],
)
def test_what_a_cancellation_means_for_a_goal_without_time(
    goal_id: str, stamp: float, is_cancelled: bool
) -> None:
    goals = GoalList()
    assert goals.accept("goal", 0.0, 1.0, 1.0)
    assert goals.cancel(goal_id, stamp) == is_cancelled


def test_a_goal_without_time_is_not_recalled() -> None:
    goals = GoalList()
    goals.cancel("", 5.0)
    assert not goals.accept("early", 4.0, 1.0, 1.0)
    assert [goal.state for goal in goals.take_ended()] == [GoalState.RECALLED]
    assert goals.accept("timeless", 0.0, 1.0, 1.0)


def test_goals_without_id_are_different_goals() -> None:
    goals = GoalList()
    assert goals.accept("", 1.0, 1.0, 1.0)
    assert goals.accept("", 2.0, 2.0, 2.0)
    first, second = goals.goals
    assert first.id != second.id
    assert (first.state, second.state) == (GoalState.PREEMPTED, GoalState.ACTIVE)
