"""A link's direction: delay, jitter, loss, order."""

from __future__ import annotations

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.experiments.delay_line import DelayLine, LinkShape

TIMES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30)


def test_frames_come_out_after_the_delay() -> None:
    line = DelayLine(LinkShape(delay=0.5))
    assert line.next_at == inf
    line.put(b"a", 1.0)
    line.put(b"b", 1.25)
    assert line.next_at == 1.5
    assert line.take(1.4) == []
    assert line.take(1.5) == [b"a"]
    assert line.take(2.0) == [b"b"]
    assert (line.carried, line.lost) == (2, 0)


@given(TIMES, st.floats(0.0, 0.2), st.integers(0, 5))
def test_frames_keep_their_order_whatever_the_jitter(gaps: list[float], jitter: float, seed: int) -> None:
    line = DelayLine(LinkShape(delay=0.2, jitter=jitter), seed)
    now = 0.0
    for number, gap in enumerate(gaps):
        now += gap
        line.put(number.to_bytes(2), now)
    assert line.next_at <= gaps[0] + 0.2 + jitter + 1e-9
    assert line.take(now + 1.0) == [number.to_bytes(2) for number in range(len(gaps))]


def test_the_share_of_lost_frames() -> None:
    line = DelayLine(LinkShape(loss=0.1), seed=3)
    for _ in range(5000):
        line.put(b"", 0.0)
    assert line.lost + len(line.take(0.0)) == 5000
    assert 400 < line.lost < 600


def test_a_full_line_loses_frames() -> None:
    line = DelayLine(LinkShape(delay=1.0), capacity=2)
    for _ in range(3):
        line.put(b"", 0.0)
    assert (len(line.take(1.0)), line.lost) == (2, 1)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"delay": 0.1, "jitter": 0.2}, "0 <= jitter <= delay, not 0.2 and 0.1"),
        ({"delay": -1.0, "jitter": -2.0}, "not -2 and -1"),
        ({"delay": inf}, "not 0 and inf"),
        ({"loss": 1.1}, "within 0 .. 1, not 1.1"),
    ],
)
def test_impossible_shapes_are_refused(values: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        LinkShape(**values)
