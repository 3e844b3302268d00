"""Heartbeats on the wire."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.multimaster.errors import MalformedHeartbeatError
from rce.ros.multimaster.heartbeat import SIZE, ZERO, Heartbeat, Kind, Stamp, decode

LAYOUT = "cBBiiHii"
SECONDS = st.integers(1, 2**31 - 1)
NANOSECONDS = st.integers(0, 999_999_999)
STAMPS = st.builds(Stamp, SECONDS, NANOSECONDS)


def test_it_has_the_layout_of_the_c_struct() -> None:
    beat = Heartbeat(Kind.STATE, 11611, 1.0, Stamp(1, 2), Stamp(3, 4))
    assert SIZE == struct.calcsize(LAYOUT) == 24
    assert beat.encode() == struct.pack(LAYOUT, b"R", 2, 10, 1, 2, 11611, 3, 4)


def test_a_request_has_a_zero_stamp_and_version_3() -> None:
    request = Heartbeat(Kind.REQUEST, 11611, 0.02)
    assert request.encode() == struct.pack(LAYOUT, b"R", 3, 0, 0, 0, 11611, 0, 0)


def test_who_leaves_says_minus_one() -> None:
    leaving = Heartbeat(Kind.LEAVING, 11611, 25.5, Stamp(5, 5), Stamp(5, 5))
    assert leaving.encode() == struct.pack(LAYOUT, b"R", 2, 255, -1, -1, 11611, -1, -1)


def test_a_state_that_is_not_known_yet_is_no_request() -> None:
    assert decode(struct.pack(LAYOUT, b"R", 2, 10, 0, 0, 1, 0, 0)).kind is Kind.STATE


@given(
    st.sampled_from(Kind),
    st.integers(0, 65535),
    st.integers(0, 255),
    st.one_of(STAMPS, st.just(ZERO)),
    STAMPS,
)
def test_what_is_written_is_read(kind: Kind, port: int, rate: int, stamp: Stamp, local: Stamp) -> None:
    beat = Heartbeat(kind, port, rate / 10, stamp, local)
    read = decode(beat.encode())
    assert (read.kind, read.rpc_port) == (kind, port)
    assert read.rate == pytest.approx(beat.rate, abs=0.1001)
    if kind is Kind.STATE:
        assert (read.stamp, read.stamp_local) == (stamp, local)


@given(st.binary(max_size=40))
def test_whatever_else_comes_is_refused_or_a_heartbeat(datagram: bytes) -> None:
    try:
        beat = decode(datagram)
    except MalformedHeartbeatError:
        return
    assert datagram[:1] == b"R"
    assert beat.kind in Kind


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"R",
        struct.pack(LAYOUT, b"X", 2, 0, 1, 0, 1, 1, 0),
        struct.pack(LAYOUT, b"R", 4, 0, 1, 0, 1, 1, 0),
    ],
)
def test_no_heartbeats(datagram: bytes) -> None:
    with pytest.raises(MalformedHeartbeatError):
        decode(datagram)


@given(st.floats(0, 2**31 - 1))
def test_stamps_keep_seconds(seconds: float) -> None:
    assert Stamp.from_seconds(seconds).seconds == pytest.approx(seconds, abs=2e-9 + seconds * 1e-15)
