"""Amounts as people write them."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.model.quantities import (
    MAX_BANDWIDTH,
    MAX_CORES,
    MAX_MEMORY,
    about,
    read_bandwidth,
    read_cores,
    read_memory,
    write_bandwidth,
    write_cores,
    write_memory,
)

READERS: list[Callable[[object], float]] = [read_cores, read_memory, read_bandwidth]


@pytest.mark.parametrize(
    ("read", "written", "meant"),
    [
        (read_cores, 0, 0.0),
        (read_cores, 0.5, 0.5),
        (read_cores, "50%", 0.5),
        (read_cores, "150 %", 1.5),
        (read_cores, "2", 2.0),
        (read_memory, 256, 256 << 20),
        (read_memory, 0.5, 512 << 10),
        (read_memory, "256", 256 << 20),
        (read_memory, "256M", 256 << 20),
        (read_memory, "256mb", 256 << 20),
        (read_memory, "512MiB", 512 << 20),
        (read_memory, "1.5G", 1536 << 20),
        (read_memory, "200000B", 200_000),
        (read_bandwidth, 5000, 5000),
        (read_bandwidth, "5000", 5000),
        (read_bandwidth, "5M", 5_000_000),
        (read_bandwidth, "2.5MB/s", 2_500_000),
        (read_bandwidth, "1MiB/s", 1 << 20),
        (read_bandwidth, "10Mbit", 1_250_000),
        (read_bandwidth, "1Gbit/s", 125_000_000),
        (read_bandwidth, "8kbitps", 1000),
    ],
)
def test_what_is_written_is_what_is_meant(
    read: Callable[[object], float], written: object, meant: float
) -> None:
    assert read(written) == meant


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize(
    "written",
    ["", "much", "-1", "1,5", "5 apples", "٣", "1e3", "0x10", "5Mb", True, None, [1], {"a": 1}, b"1"],
)
def test_what_is_no_amount_is_refused_with_an_example(
    read: Callable[[object], float], written: object
) -> None:
    if (read, written) == (read_memory, "5Mb"):
        assert read(written) == 5 << 20
        return
    with pytest.raises(ValueError, match=r"must be a number of .* such as"):
        read(written)


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("number", [-1, -0.5, math.nan, math.inf, -math.inf])
def test_what_is_no_size_is_refused(read: Callable[[object], float], number: float) -> None:
    with pytest.raises(ValueError, match="not below zero or endless"):
        read(number)


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("number", [10**400, 10**5000, 1e300, "9" * 20 + "T", "9" * 20], ids=list("abcde"))
def test_more_than_there_is_anywhere_is_refused(read: Callable[[object], float], number: object) -> None:
    with pytest.raises(ValueError, match="must be"):
        read(number)


def test_who_writes_bytes_for_mb_is_told() -> None:
    with pytest.raises(ValueError, match='a plain number is MB, bytes are written "200000000B"'):
        read_memory(200_000_000)
    assert read_memory("200000000B") == 200_000_000


@given(st.integers(0, MAX_MEMORY))
def test_memory_survives_writing_and_reading(count: int) -> None:
    assert read_memory(write_memory(count)) == count


@given(st.integers(0, MAX_BANDWIDTH))
def test_bandwidth_survives_writing_and_reading(rate: int) -> None:
    assert read_bandwidth(write_bandwidth(rate)) == rate


@given(st.integers(0, MAX_CORES * 10_000))
def test_cores_survive_writing_and_reading_to_a_ten_thousandth(count: int) -> None:
    assert read_cores(write_cores(count / 10_000)) == pytest.approx(count / 10_000, abs=1e-9)


@given(st.one_of(st.text(), st.from_regex(r"[0-9.]{1,9}\s?[a-zA-Z%/]{0,6}", fullmatch=True)))
def test_any_text_is_an_amount_or_refused(text: str) -> None:
    for read in READERS:
        try:
            amount = read(text)
        except ValueError as error:
            assert str(error).startswith("must be")  # noqa: PT017 - it may be either
        else:
            assert 0 <= amount < math.inf


@given(st.floats(0, 1e15))
def test_amounts_for_people_are_short(count: float) -> None:
    assert len(about(count)) <= 9
