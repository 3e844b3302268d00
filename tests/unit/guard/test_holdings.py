"""What a holder holds outside its queues."""

from __future__ import annotations

import gc
import weakref
from functools import partial

import pytest

from rce.guard.budget import Ledger
from rce.guard.holdings import Holdings


def test_what_is_held_is_counted_until_it_is_released() -> None:
    grown: list[int] = []
    holdings = Holdings(lambda: grown.append(holdings.bytes))
    one, other = holdings.hold(10), holdings.hold(5)
    assert grown == [10, 15]
    one.release()
    one.release()
    assert (holdings.bytes, len(holdings)) == (5, 1)
    other.release()
    assert (holdings.bytes, len(holdings)) == (0, 0)


def test_the_oldest_that_can_be_given_up_goes_first() -> None:
    gone: list[str] = []
    holdings = Holdings()
    holdings.hold(10)
    for name in "abc":
        holdings.hold(10, partial(gone.append, name))
    holdings.shed(15)
    assert gone == ["a", "b"]
    assert holdings.bytes == 20
    holdings.shed(100)
    assert gone == ["a", "b", "c"]
    assert holdings.bytes == 10


class _Owner:
    """Refers to its entry, which refers to it, as a latched message or a waiting conversion does."""

    def __init__(self, holdings: Holdings, data: bytes) -> None:
        self.data = data
        self.holding = holdings.hold(len(data), self.give_up)

    def give_up(self) -> None:
        self.data = b""


@pytest.mark.parametrize("end", ["released", "given up"])
def test_released_data_needs_no_garbage_collection(end: str) -> None:
    holdings = Holdings()
    owner = _Owner(holdings, bytes(10))
    gone = weakref.ref(owner)
    gc.disable()
    try:
        if end == "released":
            owner.holding.release()
        else:
            holdings.shed(10)
            assert owner.data == b""
        del owner
        assert gone() is None
    finally:
        gc.enable()


class _Robot:
    def __init__(self) -> None:
        self.holdings = Holdings()
        self.failed = ""

    @property
    def held(self) -> int:
        return self.holdings.bytes

    def shed(self, size: int) -> None:
        self.holdings.shed(size)

    def fail(self, reason: str) -> None:
        self.failed = reason


def test_the_sums_follow_downwards_when_they_are_refreshed() -> None:
    ledger = Ledger(per_user=100, in_all=1000)
    robot = _Robot()
    account = ledger.open("user", robot)
    holding = robot.holdings.hold(60)
    account.note()
    assert ledger.total == 60
    holding.release()
    ledger.refresh()
    assert (ledger.total, ledger.held_by("user")) == (0, 0)
