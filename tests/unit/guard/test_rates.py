from __future__ import annotations

import pytest

from rce.guard.rates import Rates


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    rates = Rates(per_second=2, burst=3)
    assert [rates.take("anna", 0.0) for _ in range(4)] == [0, 0, 0, 0.5]
    assert rates.take("anna", 0.4) == pytest.approx(0.1)
    assert rates.take("anna", 0.5) == 0
    assert rates.take("anna", 100.0) == 0
    assert [rates.take("anna", 100.0) for _ in range(3)] == [0, 0, 0.5]


def test_one_key_costs_another_nothing() -> None:
    rates = Rates(per_second=1, burst=1)
    assert [rates.take(name, 0.0) for name in ("anna", "bert", "anna")] == [0, 0, 1]


def test_cost_above_bucket_size_is_paid_afterwards() -> None:
    """What costs more than a full bucket is paid for afterwards."""
    rates = Rates(per_second=10, burst=5)
    assert rates.take("anna", 0.0) == 0
    assert rates.take("anna", 0.0, cost=100) == pytest.approx(0.1)
    assert rates.take("anna", 0.1, cost=100) == 0
    assert rates.take("anna", 0.1) == pytest.approx(9.6)


def test_a_reserved_token_can_be_given_back() -> None:
    rates = Rates(per_second=0.5, burst=2)
    assert [rates.reserve("anna", 0.0) for _ in range(4)] == [0, 0, 2, 4]
    rates.give_back("anna", 0.0)
    assert rates.reserve("anna", 0.0) == 4
    for _ in range(10):
        rates.give_back("anna", 0.0)
    assert len(rates) == 0
    assert [rates.reserve("anna", 0.0) for _ in range(3)] == [0, 0, 2]


def test_buckets_are_bounded() -> None:
    rates = Rates(per_second=1, burst=2, most_keys=10)
    for number in range(1000):
        rates.take(f"user{number}", 0.0)
    assert len(rates) == 10


@pytest.mark.parametrize(("rate", "burst"), [(0, 1), (-1, 1), (1, 0)])
def test_a_bucket_that_would_never_give_anything_is_refused(rate: float, burst: float) -> None:
    with pytest.raises(ValueError, match="bucket"):
        Rates(per_second=rate, burst=burst)
