"""Which requests of ``rce`` are sent once more."""

from __future__ import annotations

import pytest

from rce_master.cli.attempts import LEADER_S, REPEAT_S, Attempts

STANDBY = {"Retry-After": "1", "RCE-Standby": "yes"}


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def begun(method: str, masters: int = 1, clock: Clock | None = None) -> Attempts:
    attempts = Attempts(method, masters, clock or Clock())
    assert not attempts.begin()
    return attempts


@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE"])
def test_each_master_is_tried_once_if_none_gets_the_request(method: str) -> None:
    attempts = begun(method, 3)
    for _ in range(2):
        assert attempts.failed(sent=False, late=True)
        assert not attempts.begin()
    assert not attempts.failed(sent=False, late=False)


@pytest.mark.parametrize("method", ["PUT", "DELETE"])
def test_what_may_be_done_and_has_no_key_is_not_repeated(method: str) -> None:
    attempts = begun(method, 3)
    assert attempts.is_patient
    assert not attempts.failed(sent=True, late=True)


def test_a_slow_master_has_more_time_in_a_second_round() -> None:
    attempts = begun("GET", 2)
    patience = [attempts.is_patient]
    assert attempts.failed(sent=True, late=True)
    assert not attempts.begin()
    assert attempts.failed(sent=False, late=False)
    patience.append(attempts.is_patient)
    assert attempts.begin()
    assert attempts.failed(sent=True, late=True)
    assert not attempts.begin()
    assert not attempts.failed(sent=True, late=True)
    assert patience == [False, True]


def test_a_master_that_is_alone_has_its_time_at_once() -> None:
    attempts = begun("GET")
    assert attempts.is_patient
    assert not attempts.failed(sent=True, late=True)


def test_a_lost_answer_of_a_post_is_asked_for_during_a_while() -> None:
    clock = Clock()
    attempts = begun("POST", 2, clock)
    assert attempts.failed(sent=True, late=True)
    assert not attempts.begin()
    assert attempts.answered(409, {"Retry-After": "1"})
    assert attempts.begin()
    assert not attempts.answered(409, {})
    clock.now = REPEAT_S
    assert not attempts.answered(409, {"Retry-After": "1"})


def test_a_leader_is_waited_for_during_a_while() -> None:
    clock = Clock()
    attempts = begun("DELETE", 1, clock)
    assert attempts.answered(503, STANDBY)
    assert attempts.begin()
    assert attempts.answered(503, STANDBY)
    clock.now = LEADER_S
    assert not attempts.answered(503, STANDBY)
