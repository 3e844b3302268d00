"""Budgets of memory: who holds most gives way, within its own user first."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rce.guard.budget import Account, Ledger


class Robot:
    """Holds bytes of which it may throw some away."""

    def __init__(self, ledger: Ledger, user: str) -> None:
        self.loose = 0
        self.fixed = 0
        self.failures: list[str] = []
        self.account: Account = ledger.open(user, self)

    @property
    def held(self) -> int:
        return self.loose + self.fixed

    def shed(self, size: int) -> None:
        self.loose = max(0, self.loose - size)

    def fail(self, reason: str) -> None:
        self.failures.append(reason)
        self.loose = self.fixed = 0

    def take(self, loose: int = 0, fixed: int = 0) -> None:
        self.loose += loose
        self.fixed += fixed
        self.account.note()


def test_a_user_over_its_budget_loses_its_own_of_where_most_is() -> None:
    ledger = Ledger(per_user=100, in_all=1000)
    big, small, other = Robot(ledger, "u"), Robot(ledger, "u"), Robot(ledger, "v")
    other.take(90)
    big.take(80)
    small.take(40)
    assert (big.held, small.held, other.held) == (60, 40, 90)
    assert not big.failures


def test_what_was_given_back_meanwhile_is_not_counted() -> None:
    ledger = Ledger(per_user=100, in_all=1000)
    one, two = Robot(ledger, "u"), Robot(ledger, "u")
    one.take(80)
    one.loose = 0
    two.take(90)
    assert two.held == 90
    assert ledger.shed == 0


def test_who_cannot_give_anything_up_is_ended() -> None:
    ledger = Ledger(per_user=100, in_all=1000)
    stubborn, modest = Robot(ledger, "u"), Robot(ledger, "u")
    modest.take(fixed=10)
    stubborn.take(fixed=200)
    assert stubborn.failures == ["the robots of user u hold more memory of the engine than they may"]
    assert not modest.failures
    assert ledger.held_by("u") == 10


def test_all_together_over_the_budget_cost_the_largest_user() -> None:
    ledger = Ledger(per_user=100, in_all=150)
    modest, large = Robot(ledger, "a"), Robot(ledger, "b")
    large.take(90)
    modest.take(70)
    assert (modest.held, large.held) == (70, 80)
    assert ledger.total == 150


@given(
    st.lists(st.tuples(st.integers(0, 4), st.integers(0, 80), st.integers(0, 40), st.booleans()), max_size=40)
)
def test_budgets_hold_after_every_step(steps: list[tuple[int, int, int, bool]]) -> None:
    ledger = Ledger(per_user=100, in_all=220)
    robots = [Robot(ledger, user) for user in "aabbc"]
    for index, loose, fixed, drains in steps:
        if drains:
            robots[index].loose //= 2
        robots[index].take(loose, fixed)
        for user, mine in {"a": robots[:2], "b": robots[2:4], "c": robots[4:]}.items():
            assert sum(robot.held for robot in mine) <= 100, user
        assert sum(robot.held for robot in robots) <= 220
    for robot in robots:
        robot.account.close()
        robot.account.close()
    assert ledger.total == 0
    assert not ledger._sums
