"""Times on the command line of ``rce fleet``, also where clocks are changed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import datetime

import pytest
from typer import BadParameter

from rce_fleet.cli.times import read_moment, read_time

BACK = 1792890000.0
"""When clocks go from 3:00 back to 2:00 in the zone below: the 25th of October 2026, 1:00 UTC."""


@pytest.fixture(autouse=True)
def zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
        time.tzset()
        yield
    time.tzset()


def test_a_time_of_day_is_the_next_one() -> None:
    now = datetime(2026, 11, 27, 12, 0).astimezone().timestamp()
    assert read_time("18:30", now) - now == 6.5 * 3600
    assert read_time("11:30", now) - now == 23.5 * 3600
    assert read_time("2026-11-28T12:00", now) - now == 24 * 3600


@pytest.mark.parametrize(
    ("now", "text", "expected"),
    [
        (BACK - 1800, "02:45", BACK - 900),
        (BACK - 1800, "02:15", BACK + 900),
        (BACK + 1800, "02:45", BACK + 2700),
        (BACK + 1800, "2026-10-25T02:45", BACK + 2700),
        (BACK + 1800, "02:15", BACK + 86400 + 900),
        (BACK + 4000, "03:30", BACK + 5400),
        (BACK - 86400, "02:30", BACK - 1800),
    ],
)
def test_a_time_in_the_repeated_hour_comes_next(now: float, text: str, expected: float) -> None:
    assert read_time(text, now) == expected
    assert read_moment(text, now, "--start") == (BACK - 900 if "-" in text else expected)


def test_a_time_that_clocks_leave_out_is_read() -> None:
    """In spring they go from 2:00 to 3:00."""
    night = 1774742400.0  # the 29th of March 2026, 1:00 in the zone above
    assert read_time("02:30", night) == night + 5400


def test_a_moment_is_seconds_from_now_or_a_time() -> None:
    now = BACK + 86400.0
    assert [read_moment(text, now, "--start") for text in ("", "0", "600", "-5")] == [
        *(None, None, now + 600, now - 5),
    ]
    past = "2026-10-24T12:00"
    assert read_moment(past, now, "--deadline") == read_moment(past, now + 600, "--deadline")
    with pytest.raises(BadParameter, match="has passed"):
        read_time(past, now)


@pytest.mark.parametrize("text", ["soon", "25:00", "0001-01-01", "2026-13-01"])
def test_what_is_not_a_time_is_refused(text: str) -> None:
    with pytest.raises(BadParameter, match=r"expected seconds from now, or a time such as 18:30 or"):
        read_moment(text, BACK, "--deadline")
