"""What a client knows of a goal."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.actions import CommState, GoalState, IllegalTransitionError
from rce.ros.actions.tracker import GoalTracker


def tracker() -> GoalTracker:
    return GoalTracker("g", 0.0, 0.0)


def test_the_usual_way() -> None:
    goal = tracker()
    assert goal.listed(GoalState.PENDING, "", 1) == (CommState.PENDING,)
    assert goal.listed(GoalState.ACTIVE, "on it", 2) == (CommState.ACTIVE,)
    assert goal.listed(GoalState.ACTIVE, "on it", 3) == ()
    assert goal.text == "on it"
    assert goal.listed(GoalState.SUCCEEDED, "", 4) == (CommState.WAITING_FOR_RESULT,)
    assert goal.ended(GoalState.SUCCEEDED, "", 5) == (CommState.DONE,)
    assert goal.ended(GoalState.ABORTED, "", 6) == ()
    assert goal.state is GoalState.SUCCEEDED


def test_a_result_may_come_before_any_list() -> None:
    goal = tracker()
    passed = goal.ended(GoalState.PREEMPTED, "", 1)
    assert passed == (
        CommState.ACTIVE,
        CommState.PREEMPTING,
        CommState.WAITING_FOR_RESULT,
        CommState.DONE,
    )


def test_cancelling() -> None:
    goal = tracker()
    goal.listed(GoalState.ACTIVE, "", 1)
    assert goal.cancelled(2) == (CommState.WAITING_FOR_CANCEL_ACK,)
    assert goal.listed(GoalState.ACTIVE, "", 3) == ()
    assert goal.listed(GoalState.PREEMPTING, "", 4) == (CommState.PREEMPTING,)
    assert goal.cancelled(5) == ()
    assert goal.ended(GoalState.PREEMPTED, "", 6)[-1] is CommState.DONE


def test_a_goal_that_its_server_forgot_is_lost() -> None:
    goal = tracker()
    assert goal.not_listed(1) == ()
    goal.listed(GoalState.ACTIVE, "", 2)
    assert goal.not_listed(3) == (CommState.DONE,)
    assert (goal.state, goal.text) == (GoalState.LOST, "the server does not list the goal any longer")


def test_a_goal_cancelled_at_once_is_not_lost_by_an_older_list() -> None:
    goal = tracker()
    goal.cancelled(0)
    assert goal.not_listed(0) == ()


def test_goal_with_result_under_way_may_be_unlisted() -> None:
    """A goal whose result is on the way may be missing in the list."""
    goal = tracker()
    goal.listed(GoalState.SUCCEEDED, "", 1)
    assert goal.not_listed(2) == ()
    assert goal.check(10, heard_at=10, silence_timeout=10) == ()
    assert goal.check(12, heard_at=12, silence_timeout=10) == (CommState.DONE,)
    assert goal.state is GoalState.LOST


def test_a_silent_server_loses_the_goal() -> None:
    goal = tracker()
    goal.listed(GoalState.ACTIVE, "", 1)
    assert goal.check(100, heard_at=95, silence_timeout=10) == ()
    assert goal.check(100, heard_at=1, silence_timeout=math.inf) == ()
    assert goal.check(100, heard_at=89, silence_timeout=10) == (CommState.DONE,)
    assert goal.text == "the server is silent"


def test_what_the_server_does_not_show_to_know_is_repeated() -> None:
    goal = tracker()
    assert not goal.must_repeat(0.9)
    assert goal.must_repeat(1.0)
    assert not goal.must_repeat(1.9)
    goal.listed(GoalState.ACTIVE, "", 2)
    assert not goal.must_repeat(9)
    goal.cancelled(9)
    assert not goal.must_repeat(9.5)
    assert goal.must_repeat(10)
    goal.listed(GoalState.PREEMPTING, "", 11)
    assert not goal.must_repeat(20)


def test_what_cannot_be_changes_nothing() -> None:
    goal = tracker()
    goal.listed(GoalState.ACTIVE, "", 1)
    with pytest.raises(IllegalTransitionError, match=r"goal g is ACTIVE: expected .*, found PENDING"):
        goal.listed(GoalState.PENDING, "text", 2)
    assert (goal.comm, goal.state, goal.text) == (CommState.ACTIVE, GoalState.ACTIVE, "")


steps = st.tuples(
    st.sampled_from(["listed", "missing", "ended", "cancel", "check"]), st.sampled_from(GoalState)
)


@given(st.lists(steps))
def test_nothing_happens_after_the_end(story: list[tuple[str, GoalState]]) -> None:
    goal = tracker()
    for now, (what, state) in enumerate(story):
        was_done, before = goal.is_done, (goal.comm, goal.state)
        passed: tuple[CommState, ...] = ()
        try:
            match what:
                case "listed":
                    passed = goal.listed(state, "", now)
                case "missing":
                    passed = goal.not_listed(now)
                case "ended":
                    passed = goal.ended(state, "", now)
                case "cancel":
                    passed = goal.cancelled(now)
                case _:
                    passed = goal.check(now, now - 5, 3)
        except IllegalTransitionError:
            assert (goal.comm, goal.state) == before
        if was_done:
            assert passed == ()
            assert (goal.comm, goal.state) == before
        if passed:
            assert passed[-1] is goal.comm
