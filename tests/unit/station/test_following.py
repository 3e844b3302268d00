"""Changes in order, with gaps, late joiners and restarted planners."""

from __future__ import annotations

from random import Random
from typing import Any

import pytest

from rce_fleet.coordination.following import MOST_EARLY, ChangeFollower

A, B = "10.000000001", "20.000000002"
"""When two planners began."""


def snapshot(sequence: int, started: str = A) -> dict[str, Any]:
    return {"sequence": sequence, "state": {"started": started}}


def change(sequence: int, started: str = A, **parts: object) -> dict[str, Any]:
    empty: dict[str, Any] = {"robots": [], "removed": [], "blocked": [], "pending": [], "freed": []}
    return {**empty, "started": started, "sequence": sequence, "freed": [sequence], **parts}


def repeated(sequence: int, started: str = A) -> dict[str, Any]:
    return change(sequence, started, freed=[])


@pytest.fixture
def follower() -> ChangeFollower:
    """Knows everything up to change 5 of planner A."""
    made = ChangeFollower()
    made.take_snapshot(snapshot(5))
    return made


def test_a_late_joiner_needs_the_whole_state() -> None:
    follower = ChangeFollower()
    assert (follower.is_behind, follower.follows) == (True, False)
    assert not follower.take_changes(change(7))
    assert follower.take_snapshot(snapshot(7)) == []
    assert not follower.is_behind
    assert follower.take_changes(change(8))


def test_changes_that_come_before_the_state_follow_upon_it() -> None:
    follower = ChangeFollower()
    for number in (6, 7, 8):
        follower.take_changes(change(number))
    assert follower.take_snapshot(snapshot(6)) == [change(7), change(8)]
    assert not follower.is_behind


def test_changes_are_taken_one_by_one(follower: ChangeFollower) -> None:
    assert follower.take_changes(change(6))
    assert follower.take_changes(change(7))
    assert not follower.take_changes(change(7)), "it is known"
    assert not follower.take_changes(repeated(7))
    assert not follower.is_behind


@pytest.mark.parametrize("part", ["zones", "removed_zones", "blocks", "removed_blocks"])
def test_a_change_may_have_one_part_only(follower: ChangeFollower, part: str) -> None:
    assert follower.take_changes({**repeated(6), part: [1]})
    assert not follower.is_behind


def test_a_number_that_is_left_out_is_noticed(follower: ChangeFollower) -> None:
    assert not follower.take_changes(change(7))
    assert follower.is_behind
    assert not follower.take_changes(change(8))
    assert follower.take_snapshot(snapshot(6)) == [change(7), change(8)]


def test_the_last_change_is_missed_by_its_repeated_number(follower: ChangeFollower) -> None:
    assert not follower.take_changes(repeated(6))
    assert follower.is_behind
    assert follower.take_snapshot(snapshot(6)) == []
    assert not follower.is_behind


def test_a_restarted_planner_is_noticed(follower: ChangeFollower) -> None:
    assert not follower.take_changes(repeated(0, B))
    assert follower.is_behind
    follower.take_changes(change(1, B))
    assert follower.take_snapshot(snapshot(0, B)) == [change(1, B)]
    assert not follower.take_changes(change(6, A)), "the former planner"
    assert follower.is_behind


def test_changes_of_a_former_planner_are_dropped() -> None:
    follower = ChangeFollower()
    follower.take_changes(change(9, A))
    assert follower.take_snapshot(snapshot(3, B)) == []
    assert not follower.is_behind


def test_a_gap_among_early_changes_needs_another_state() -> None:
    follower = ChangeFollower()
    for number in (6, 8):
        follower.take_changes(change(number))
    assert follower.take_snapshot(snapshot(5)) == [change(6)]
    assert follower.is_behind
    assert follower.take_snapshot(snapshot(8)) == []
    assert not follower.is_behind


def test_early_changes_are_bounded() -> None:
    follower = ChangeFollower()
    for number in range(1, MOST_EARLY + 10):
        follower.take_changes(change(number))
    assert follower.take_snapshot(snapshot(3)) == []
    assert follower.is_behind, "change 4 was dropped"


class Replica:
    """A copy of what a planner knows, over a network that loses messages and answers late."""

    def __init__(self, seed: int) -> None:
        self.rng = Random(seed)
        self.follower = ChangeFollower()
        self.life = self.number = 0
        self.planner: dict[str, int] = {}
        self.copy: dict[str, int] = {}
        self.answer: dict[str, Any] | None = None

    def change_something(self) -> None:
        if self.rng.random() < 0.02:
            self.life, self.number = self.life + 1, 0
            self.planner.clear()
        robot, value = f"R{self.rng.randrange(5)}", self.rng.randrange(1000)
        self.number += 1
        self.planner[robot] = value
        if self.rng.random() > 0.1:
            self.deliver(change(self.number, str(self.life), robots=[{"id": robot, "value": value}]))

    def deliver(self, message: dict[str, Any]) -> None:
        if self.follower.take_changes(message):
            self.apply(message)
        if self.follower.is_behind and self.answer is None:
            state = {"started": str(self.life), "robots": dict(self.planner)}
            self.answer = {"sequence": self.number, "state": state}

    def take_answer(self) -> None:
        answer, self.answer = self.answer, None
        if answer is not None:
            early = self.follower.take_snapshot(answer)
            self.copy = dict(answer["state"]["robots"])
            for message in early:
                self.apply(message)

    def apply(self, message: dict[str, Any]) -> None:
        self.copy.update({robot["id"]: robot["value"] for robot in message["robots"]})


@pytest.mark.parametrize("seed", range(20))
def test_state_is_right_whatever_gets_lost(seed: int) -> None:
    """Messages get lost, states come late, the planner is restarted; in the end all is known."""
    replica = Replica(seed)
    for _ in range(300):
        replica.change_something()
        if replica.rng.random() < 0.3:
            replica.take_answer()
    for _ in range(4):
        replica.deliver(repeated(replica.number, str(replica.life)))
        replica.take_answer()
    assert not replica.follower.is_behind
    assert replica.copy == replica.planner
