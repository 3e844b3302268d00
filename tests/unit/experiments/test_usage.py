"""Shares of a core, as the kernel takes them."""

from __future__ import annotations

import pytest

from rce_fleet.experiments.usage import PERIOD_US, period_us, quota_us


@pytest.mark.parametrize("cores", [0.001, 0.0047, 0.0213, 0.2, 1.0, 2.0])
def test_a_share_has_a_quota_and_a_period_that_the_kernel_takes(cores: float) -> None:
    assert quota_us(cores) >= 1_000
    assert 1_000 <= period_us(cores) <= 1_000_000
    assert quota_us(cores) / period_us(cores) == pytest.approx(cores, rel=0.01)


def test_a_machine_stops_for_long_only_if_its_share_is_very_small() -> None:
    assert period_us(0.2) == 10_000
    assert period_us(0.01) == period_us(0.0) == PERIOD_US
    assert period_us(0.005) == 200_000
