"""What a server remembers of goals."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rce.ros.actions import GoalEvent, GoalId, GoalState, IllegalTransitionError, UnknownGoalError
from rce.ros.actions.ledger import Arrival, GoalLedger


def states(ledger: GoalLedger, now: float = 0) -> dict[str, str]:
    ledger.validate()
    return {entry.goal_id.id: entry.state.name for entry in ledger.listed(now)}


def with_goals(*stamps: int) -> GoalLedger:
    ledger = GoalLedger()
    for stamp in stamps:
        assert ledger.receive(GoalId(f"g{stamp}", stamp), 0) is Arrival.NEW
    return ledger


def test_a_goal_that_comes_twice_is_one() -> None:
    ledger = with_goals(1)
    ledger.apply("g1", GoalEvent.ACCEPT, 0)
    assert ledger.receive(GoalId("g1", 1), 0) is Arrival.REPEATED
    assert states(ledger) == {"g1": "ACTIVE"}


@pytest.mark.parametrize(
    ("request_id", "asked"),
    [
        (GoalId(), ["g1", "g2", "g3"]),
        (GoalId("g2"), ["g2"]),
        (GoalId("", 2), ["g1", "g2"]),
        (GoalId("g3", 1), ["g1", "g3"]),
        (GoalId("unknown"), []),
    ],
)
def test_who_is_meant_by_a_cancellation(request_id: GoalId, asked: list[str]) -> None:
    assert with_goals(1, 2, 3).cancel(request_id, 0) == asked


def test_a_cancellation_asks_once_and_only_what_is_not_over() -> None:
    ledger = with_goals(1, 2, 3)
    ledger.apply("g1", GoalEvent.REJECT, 0)
    ledger.apply("g2", GoalEvent.ACCEPT, 0)
    assert ledger.cancel(GoalId(), 0) == ["g2", "g3"]
    assert ledger.cancel(GoalId(), 0) == []
    assert states(ledger) == {"g1": "REJECTED", "g2": "PREEMPTING", "g3": "RECALLING"}


def test_a_cancellation_may_overtake_its_goal() -> None:
    ledger = GoalLedger()
    ledger.cancel(GoalId("g"), 0)
    assert states(ledger) == {"g": "RECALLING"}
    assert ledger.receive(GoalId("g", 5), 1) is Arrival.CANCELLED
    assert ledger["g"].goal_id.stamp == 5
    assert states(ledger, 5.9) == {"g": "RECALLED"}
    assert states(ledger, 6.1) == {}


def test_goals_older_than_cancellation_are_cancelled() -> None:
    """Goals older than a cancellation are cancelled when they come."""
    ledger = GoalLedger()
    ledger.cancel(GoalId("", 5), 0)
    assert ledger.receive(GoalId("old", 5), 0) is Arrival.CANCELLED
    assert ledger.receive(GoalId("new", 6), 0) is Arrival.NEW
    assert ledger.receive(GoalId("timeless"), 0) is Arrival.NEW
    assert states(ledger) == {"old": "RECALLED", "new": "PENDING", "timeless": "PENDING"}


def test_goals_that_are_over_are_remembered_for_a_while() -> None:
    ledger = with_goals(1, 2)
    ledger.apply("g1", GoalEvent.ACCEPT, 0)
    ledger.apply("g1", GoalEvent.SUCCEED, 10)
    assert states(ledger, 15) == {"g1": "SUCCEEDED", "g2": "PENDING"}
    assert ledger.receive(GoalId("g1", 1), 14) is Arrival.REPEATED
    assert states(ledger, 19) == {"g1": "SUCCEEDED", "g2": "PENDING"}
    assert states(ledger, 20) == {"g2": "PENDING"}
    with pytest.raises(UnknownGoalError, match="g1"):
        ledger.apply("g1", GoalEvent.ABORT, 20)


def test_what_is_not_possible_changes_nothing() -> None:
    ledger = with_goals(1)
    with pytest.raises(IllegalTransitionError, match=r"goal g1 is PENDING: expected .*, found SUCCEED"):
        ledger.apply("g1", GoalEvent.SUCCEED, 0, "text")
    assert (ledger["g1"].state, ledger["g1"].text) == (GoalState.PENDING, "")


events = st.tuples(
    st.sampled_from(["goal", "cancel", *GoalEvent]), st.integers(0, 4), st.integers(0, 9), st.floats(0, 3)
)


@given(st.lists(events))
@example([("cancel", 1, 0, 0.0), (GoalEvent.REJECT, 1, 0, 0.0), ("goal", 1, 0, 0.0)])
def test_the_ledger_is_always_sound(story: list[tuple[object, int, int, float]]) -> None:
    ledger, now = GoalLedger(), 0.0
    seen: dict[str, GoalState] = {}
    for what, number, stamp, wait in story:
        now += wait
        goal_id = GoalId(f"g{number}" if number else "", stamp)
        if what == "goal" and number:
            ledger.receive(goal_id, now)
        elif what == "cancel":
            ledger.cancel(goal_id, now)
        elif isinstance(what, GoalEvent) and number:
            with suppress(IllegalTransitionError, UnknownGoalError):
                ledger.apply(goal_id.id, what, now)
        ledger.validate()
        present = {entry.goal_id.id: entry.state for entry in ledger.listed(now)}
        for key, state in seen.items():
            if state.is_over and key in present:
                assert present[key] is state
        seen = present
    remaining = ledger.listed(now + 100)
    assert not any(entry.state.is_over for entry in remaining)
