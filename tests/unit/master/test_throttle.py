from __future__ import annotations

import contextlib

from rce_master.throttle import (
    FREE,
    FREE_OF_ADDRESS,
    MAX_ADDRESS_DELAY_S,
    MAX_DELAYED,
    PACE_OF_ADDRESS_S,
    PACE_S,
    FailureThrottle,
    pair_of,
)

ZOE = pair_of("a", "zoe")


def fail(throttle: FailureThrottle, count: int, pair: str = ZOE) -> list[float]:
    return [throttle.take(pair, 0.0) for _ in range(count)]


def test_failures_of_a_user_come_one_at_a_time() -> None:
    """Those that have to wait are not counted, and take nothing from those that come later."""
    throttle = FailureThrottle()
    assert fail(throttle, FREE + 3) == [0.0] * FREE + [PACE_S] * 3
    assert throttle.take(ZOE, PACE_S) == 0
    assert throttle.take(ZOE, PACE_S) == PACE_S


def test_one_address_or_user_costs_another_nothing() -> None:
    throttle = FailureThrottle()
    fail(throttle, FREE + 1)
    assert throttle.take(pair_of("b", "zoe"), 0.0) == 0
    assert throttle.take(pair_of("a", "anna"), 0.0) == 0


def test_one_address_that_tries_many_users_is_slowed_down() -> None:
    """And never refused for that: others share the address. What it owes does not grow."""
    throttle = FailureThrottle()
    delays = [throttle.admit("a", 0.0) for _ in range(2 * FREE_OF_ADDRESS)]
    assert delays == sorted(delays)
    assert delays.count(0.0) == FREE_OF_ADDRESS
    assert delays[-1] == MAX_ADDRESS_DELAY_S
    assert throttle.admit("a", MAX_ADDRESS_DELAY_S + 2 * PACE_OF_ADDRESS_S) == 0


def test_success_costs_nothing() -> None:
    throttle = FailureThrottle()
    for _ in range(10 * FREE_OF_ADDRESS):
        assert throttle.admit("a", 0.0) == 0
        assert throttle.take(ZOE, 0.0) == 0
        throttle.passed("a", ZOE, 0.0)


def test_only_so_many_are_put_off_at_once() -> None:
    """Beyond it, one of each address and user, so that a flood keeps no other one out."""
    throttle = FailureThrottle()
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_DELAYED):
            assert not throttle.is_crowded(ZOE)
            stack.enter_context(throttle.delaying(ZOE))
        assert throttle.is_crowded(ZOE)
        assert not throttle.is_crowded(pair_of("a", "anna"))
        assert not throttle.is_crowded(pair_of("b", "zoe"))
    assert not throttle.delayed
    assert not throttle.is_crowded(ZOE)
