"""Medians, intervals and effect sizes."""

from __future__ import annotations

from math import isnan

import numpy as np
import pytest
from scipy.stats import bootstrap

from rce_fleet.experiments.statistics import effect_size, estimate


def test_the_interval_is_that_of_scipy() -> None:
    values = np.random.default_rng(1).exponential(1.0, 12)
    found = estimate(list(values))
    other = bootstrap(
        (values,), np.median, n_resamples=20_000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    assert found.median == pytest.approx(np.median(values))
    assert (found.low, found.high) == pytest.approx((other.low, other.high), rel=0.05)
    assert found == estimate(list(values))


@pytest.mark.slow
def test_the_interval_covers_the_true_median() -> None:
    """In some 95 of 100 experiments; the percentile bootstrap of 10 runs is a little too narrow."""
    random = np.random.default_rng(7)
    covered = sum(0.0 in estimate(list(random.normal(0.0, 1.0, 10)), seed=run) for run in range(200))
    assert covered >= 176


@pytest.mark.slow
def test_the_interval_of_three_runs_is_their_range() -> None:
    """By hand: all three are above the true median, or all below it, in 2 / 8 of the experiments."""
    random = np.random.default_rng(7)
    samples = random.normal(0.0, 1.0, (400, 3))
    found = [estimate(list(sample)) for sample in samples]
    assert [(one.low, one.high) for one in found] == [(min(sample), max(sample)) for sample in samples]
    assert sum(0.0 in one for one in found) / len(found) == pytest.approx(0.75, abs=0.06)


def test_few_runs_have_no_interval() -> None:
    found = estimate([1.0, 3.0])
    assert (found.median, found.runs) == (2.0, 2)
    assert isnan(found.low)
    assert 2.0 not in found


def test_effect_size() -> None:
    assert effect_size([3, 4], [1, 2]) == 1.0
    assert effect_size([1, 2], [3, 4]) == -1.0
    assert effect_size([1, 2], [1, 2]) == 0.0
    assert effect_size([2, 3], [1, 2]) == 0.75


@pytest.mark.parametrize("values", [[], [1.0, float("nan")]])
def test_samples_without_finite_values_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="finite values"):
        estimate(values)
