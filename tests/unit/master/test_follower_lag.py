"""How far a stand-by's copy of the state is behind."""

from __future__ import annotations

from rce_master.follower import Lag


def test_a_copy_that_has_the_last_save_has_no_lag() -> None:
    lag = Lag()
    assert (lag.revisions, lag.seconds(50.0)) == (0, 0.0)
    lag.has(20, 100.0)
    lag.saw(15, 101.0)
    assert (lag.revisions, lag.seconds(102.0)) == (0, 0.0)


def test_lag_counts_from_the_first_save_that_is_missing() -> None:
    lag = Lag()
    lag.has(10, 100.0)
    lag.saw(12, 101.0)
    lag.saw(17, 103.0)
    assert (lag.revisions, lag.seconds(104.0)) == (7, 3.0)
    lag.has(12, 105.0)
    assert (lag.revisions, lag.seconds(106.0)) == (5, 5.0)
    lag.has(17, 107.0)
    assert (lag.revisions, lag.seconds(108.0)) == (0, 0.0)


def test_without_a_copy_everything_is_missing() -> None:
    lag = Lag()
    lag.has(10, 100.0)
    lag.saw(10, 100.0)
    lag.has(0, 200.0)
    assert (lag.revisions, lag.seconds(203.0)) == (10, 3.0)
