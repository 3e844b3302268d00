"""Pairs with the smallest sum of costs: as many and as cheap as scipy's, in both forms of the loops."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rce_fleet.compiled import is_available
from rce_fleet.tasks import matching, matching_loops
from rce_fleet.tasks.matching import cheapest_pairs
from rce_fleet.tasks.matching_loops import match_rows

Floats = NDArray[np.float64]
FORBIDDEN = 1e6
"""For scipy: more than all costs of a test together."""


@st.composite
def drawn(draw: st.DrawFn) -> Floats:
    """Return costs, often equal ones or with forbidden pairs."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.integers(0, 14)), draw(st.integers(0, 14))
    greatest = draw(st.sampled_from((1, 3, 50, 0)))
    costs: Floats
    if greatest:
        costs = rng.integers(-greatest, greatest, shape).astype(np.float64)
    else:
        costs = rng.uniform(-100.0, 100.0, shape)
    if draw(st.booleans()):
        costs += rng.integers(0, 40, (shape[0], 1))
    costs[rng.random(shape) < draw(st.sampled_from((0.0, 0.2, 0.9)))] = np.inf
    return costs


def check(costs: Floats) -> None:
    """Compare with scipy's pairs."""
    rows, columns = cheapest_pairs(costs)
    assert len(set(rows)) == len(set(columns)) == len(rows)
    assert (np.diff(rows) > 0).all()
    known = np.where(np.isinf(costs), FORBIDDEN, costs)
    best = linear_sum_assignment(known)
    allowed = np.isfinite(costs[best])
    assert len(rows) == allowed.sum()
    assert costs[rows, columns].sum() == pytest.approx(costs[best][allowed].sum(), abs=1e-6)


@given(drawn())
def test_pairs_are_as_cheap_as_scipys(costs: Floats) -> None:
    check(costs)


@pytest.mark.parametrize("shortlist", [2, 5, 128])
@given(costs=drawn())
def test_the_loop_finds_the_least_sum(costs: Floats, shortlist: int) -> None:
    """The loop as plain Python, also with shortlists that are too short for most searches."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "match_rows", match_rows.loop)
        patch.setattr(matching_loops, "SHORTLIST", shortlist)
        patch.setattr(matching_loops, "_SAMPLE", min(shortlist, 3))
        check(costs)


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    if not is_available():
        pytest.skip("numba is not installed")
    monkeypatch.setattr(matching, "match_rows", match_rows.compile())


def _grid(rng: np.random.Generator) -> Floats:
    """Ways on a floor without walls: few different numbers."""
    places = rng.integers(0, 60, (4, 300))
    ways = abs(places[0][:, None] - places[1]) + abs(places[2][:, None] - places[3])
    return np.asarray(ways * 2.5)


LARGE: dict[str, Callable[[np.random.Generator], Floats]] = {
    "uniform": lambda rng: rng.uniform(0, 300, (300, 300)),
    "floor": _grid,
    "urgent": lambda rng: _grid(rng) - rng.uniform(0, 900, (300, 1)),
    "more columns": lambda rng: rng.uniform(0, 300, (150, 400)) - rng.integers(0, 3, 400) * 100.0,
    "more rows": lambda rng: rng.integers(0, 300, (400, 150)).astype(np.float64),
    "equal": lambda _rng: np.full((200, 200), 7.0),
    "few stations": lambda rng: np.repeat(_grid(rng)[:, :10], 30, axis=1),
    "products": lambda _rng: np.outer(np.arange(200.0), np.arange(200.0)),
    "one is far": lambda rng: np.where(np.eye(200) > 0, 0.0, rng.uniform(1000, 1001, (200, 200))),
    "forbidden": lambda rng: np.where(rng.random((300, 300)) < 0.985, np.inf, _grid(rng)),
}


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("name", LARGE)
def test_compiled_pairs_are_as_cheap_as_scipys(name: str) -> None:
    for seed in range(3):
        check(LARGE[name](np.random.default_rng(seed)))


@pytest.mark.parametrize("wrong", [np.nan, -np.inf])
def test_nan_as_a_cost_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match="a cost must be a number or inf"):
        cheapest_pairs(np.array([[1.0, wrong], [2.0, 3.0]]))
