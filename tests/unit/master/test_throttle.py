from __future__ import annotations

import contextlib

import pytest

from rce_master.exceptions import TooManyFailuresError
from rce_master.throttle import (
    FREE,
    FREE_OF_ADDRESS,
    MAX_ADDRESS_DELAY_S,
    MAX_DELAY_S,
    MAX_DELAYED,
    PACE_OF_ADDRESS_S,
    PACE_S,
    FailureThrottle,
)


def fail(throttle: FailureThrottle, count: int, address: str = "a", user: str = "zoe") -> list[float]:
    return [throttle.admit(address, user, 0.0) for _ in range(count)]


def test_failures_are_slowed_then_refused() -> None:
    """Failures are slowed down and refused only when that takes too long."""
    throttle = FailureThrottle()
    assert fail(throttle, FREE + 1) == [0.0] * FREE + [PACE_S]
    for _ in range(3):
        with pytest.raises(TooManyFailuresError, match="try again in 6 s"):
            throttle.admit("a", "zoe", 0.0)
    assert throttle.admit("a", "zoe", 2.0) <= MAX_DELAY_S


def test_one_address_or_user_costs_another_nothing() -> None:
    throttle = FailureThrottle()
    fail(throttle, FREE + 1)
    assert throttle.admit("b", "zoe", 0.0) == 0
    assert throttle.admit("a", "anna", 0.0) == 0


def test_one_address_that_tries_many_users_is_slowed_down() -> None:
    """And never refused for that: others share the address. What it owes does not grow."""
    throttle = FailureThrottle()
    delays = [throttle.admit("a", f"user{number}", 0.0) for number in range(2 * FREE_OF_ADDRESS)]
    assert delays == sorted(delays)
    assert delays.count(0.0) == FREE_OF_ADDRESS
    assert delays[-1] == MAX_ADDRESS_DELAY_S
    assert throttle.admit("a", "one_more", MAX_ADDRESS_DELAY_S + 2 * PACE_OF_ADDRESS_S) == 0


def test_success_costs_nothing() -> None:
    throttle = FailureThrottle()
    for _ in range(10 * FREE_OF_ADDRESS):
        assert throttle.admit("a", "zoe", 0.0) == 0
        throttle.passed("a", "zoe", 0.0)


def test_only_so_many_are_put_off_at_once() -> None:
    """Beyond it, one of each address and user, so that a flood keeps no other one out."""
    throttle = FailureThrottle()
    fail(throttle, FREE)
    fail(throttle, FREE, user="anna")
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_DELAYED):
            stack.enter_context(throttle.delaying("a", "zoe"))
        with pytest.raises(TooManyFailuresError):
            throttle.admit("a", "zoe", 0.0)
        assert throttle.admit("a", "anna", 0.0) == PACE_S
        assert throttle.admit("b", "zoe", 0.0) == 0
    assert not throttle.delayed
    assert throttle.admit("a", "zoe", 0.0) == PACE_S
