"""Pauses between attempts to connect, to start and to fetch."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.aio.backoff import Backoff

SECONDS = st.floats(0.001, 100.0)


def test_pauses_double_up_to_the_longest() -> None:
    backoff = Backoff(first=0.5, longest=3.0)
    assert [backoff.pause_after(failures) for failures in (-1, 0, 1, 2, 3, 4, 10**9)] == [
        0.0, 0.0, 0.5, 1.0, 2.0, 3.0, 3.0,
    ]  # fmt: skip


def test_pauses_without_jitter_are_exact() -> None:
    pauses = Backoff(first=0.25, longest=1.0).start()
    assert [pauses.next() for _ in range(4)] == [0.25, 0.5, 1.0, 1.0]


def test_reset_begins_with_the_first_pause_again() -> None:
    pauses = Backoff(first=0.25, longest=1.0).start()
    pauses.next()
    pauses.next()
    pauses.reset()
    assert pauses.next() == 0.25


@given(first=SECONDS, more=SECONDS, jitter=st.floats(0, 1), seed=st.integers(), count=st.integers(1, 80))
def test_pauses_keep_within_their_bounds(
    first: float, more: float, jitter: float, seed: int, count: int
) -> None:
    backoff = Backoff(first, first + more, jitter)
    pauses = backoff.start(random.Random(seed))
    bounds = [backoff.pause_after(failures) for failures in range(1, count + 1)]
    for bound, pause in zip(bounds, (pauses.next() for _ in bounds), strict=True):
        assert bound * (1 - jitter) * (1 - 1e-9) <= pause <= bound
    assert bounds == sorted(bounds)
    assert bounds[0] == first
    assert bounds[-1] <= backoff.longest


@pytest.mark.parametrize(("jitter", "least"), [(1.0, 0.0), (0.5, 0.5)])
def test_jitter_uses_its_whole_range(jitter: float, least: float) -> None:
    pauses = Backoff(1.0, 1.0, jitter).start(random.Random(1))
    drawn = [pauses.next() for _ in range(1000)]
    assert min(drawn) < least + 0.05
    assert max(drawn) > 0.95


def test_loops_do_not_disturb_each_other() -> None:
    backoff = Backoff(first=1.0, longest=8.0)
    one, other = backoff.start(), backoff.start()
    assert [one.next(), one.next(), other.next()] == [1.0, 2.0, 1.0]


@pytest.mark.parametrize(("first", "longest", "jitter"), [(-1, 1, 0), (2, 1, 0), (1, 2, -1), (1, 2, 1.1)])
def test_impossible_bounds_are_refused(first: float, longest: float, jitter: float) -> None:
    with pytest.raises(
        ValueError, match="expected 0 <= first <= longest and 0 <= jitter <= 1, found Backoff"
    ):
        Backoff(first, longest, jitter)
