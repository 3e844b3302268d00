from __future__ import annotations

import pytest

from rce_master.exceptions import TooManyFailures
from rce_master.throttle import FREE, FREE_OF_ADDRESS, MAX_DELAY_S, MAX_DELAYED, PACE_S, FailureThrottle


def fail(throttle: FailureThrottle, count: int, address: str = "a", user: str = "zoe") -> list[float]:
    return [throttle.admit(address, user, 0.0) for _ in range(count)]


def test_failures_are_slowed_down_and_refused_only_when_that_takes_too_long() -> None:
    throttle = FailureThrottle()
    assert fail(throttle, FREE + 1) == [0.0] * FREE + [PACE_S]
    for _ in range(3):
        with pytest.raises(TooManyFailures, match="try again in 6 s"):
            throttle.admit("a", "zoe", 0.0)
    assert throttle.admit("a", "zoe", 2.0) <= MAX_DELAY_S


def test_one_address_or_user_costs_another_nothing() -> None:
    throttle = FailureThrottle()
    fail(throttle, FREE + 1)
    assert throttle.admit("b", "zoe", 0.0) == 0
    assert throttle.admit("a", "anna", 0.0) == 0


def test_one_address_that_tries_many_users_is_slowed_down() -> None:
    throttle = FailureThrottle()
    delays = [throttle.admit("a", f"user{number}", 0.0) for number in range(FREE_OF_ADDRESS + 10)]
    assert delays == sorted(delays)
    assert delays.count(0.0) == FREE_OF_ADDRESS
    with pytest.raises(TooManyFailures):
        throttle.admit("a", "one_more", 0.0)


def test_success_costs_nothing() -> None:
    throttle = FailureThrottle()
    for _ in range(10 * FREE_OF_ADDRESS):
        assert throttle.admit("a", "zoe", 0.0) == 0
        throttle.passed("a", "zoe", 0.0)


def test_only_so_many_are_put_off_at_once() -> None:
    throttle = FailureThrottle()
    fail(throttle, FREE)
    throttle.delayed = MAX_DELAYED
    with pytest.raises(TooManyFailures):
        throttle.admit("a", "zoe", 0.0)
    assert throttle.admit("b", "zoe", 0.0) == 0
