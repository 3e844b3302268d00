"""The frame codec: what is written is read, however it is cut; what is not a frame is refused."""

from __future__ import annotations

from contextlib import suppress
from itertools import zip_longest
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.link.exceptions import LinkRefusedError, ProtocolError
from rce.link.frame_reader import FrameReader
from rce.link.frames import (
    HANDSHAKE_SIZE,
    HEADER,
    LATCHED,
    Frame,
    FrameType,
    encode,
    pack_fragment,
    pack_header,
)
from rce.link.handshake import check_answer, encode_hello, parse_hello
from rce.link.settings import LinkLimits

LIMITS = LinkLimits(max_message=2_000_000, unfinished_bytes=3_000_000)

SMALL = st.builds(
    Frame,
    st.sampled_from([FrameType.OPEN, FrameType.CLOSE, FrameType.PING, FrameType.FAULT, FrameType.DATA]),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 255),
    st.binary(max_size=300),
)
LARGE = st.builds(
    lambda kind, channel, call_id, size, seed: Frame(kind, channel, call_id, 0, bytes([seed]) * size),
    st.sampled_from([FrameType.DATA, FrameType.CALL, FrameType.REPLY]),
    st.integers(0, 3),
    st.integers(0, 2**32 - 1),
    st.integers(16_000, 140_000),
    st.integers(0, 255),
)


def fragments(frame: Frame, size: int) -> list[bytes]:
    """Write a message in parts of ``size`` bytes."""
    total = len(frame.payload)
    parts = [bytes(frame.payload[start : start + size]) for start in range(0, total, size)]
    first = pack_header(frame, len(parts[0]), total) + parts[0]
    return [first, *(pack_fragment(frame.channel, len(part), total) + part for part in parts[1:])]


def fill(reader: FrameReader, data: bytes, cuts: list[int]) -> list[Frame]:
    """Hand bytes over as an event loop does, at most ``cuts`` bytes at a time, in turn."""
    frames: list[Frame] = []
    turn = 0
    while data:
        buffer = reader.get_buffer()
        assert len(buffer) > 0
        count = min(len(buffer), len(data), cuts[turn % len(cuts)])
        buffer[:count] = data[:count]
        frames += reader.advance(count)
        data, turn = data[count:], turn + 1
    return frames


@given(
    st.lists(SMALL | LARGE, max_size=6),
    st.lists(st.sampled_from([1, 7, 23, 24, 25, 100, 4_000, 70_000, 10**6]), min_size=1, max_size=5),
)
def test_frames_survive_any_cut(frames: list[Frame], cuts: list[int]) -> None:
    if max(cuts) < 100:
        cuts = [*cuts, 5_000]
    assert fill(FrameReader(LIMITS), b"".join(map(encode, frames)), cuts) == frames


@given(
    st.lists(LARGE, min_size=1, max_size=4, unique_by=lambda frame: frame.channel),
    st.lists(SMALL, max_size=4),
    st.integers(1, 50_000),
    st.integers(1, 100_000),
    st.randoms(use_true_random=False),
)
def test_interleaved_fragments_are_put_together(
    large: list[Frame], small: list[Frame], part: int, cut: int, random: Random
) -> None:
    lines = [fragments(frame, max(part, 5_000)) for frame in large] + [[encode(frame)] for frame in small]
    written: list[bytes] = []
    while lines := [line for line in lines if line]:
        line = random.choice(lines)
        written.append(line.pop(0))
    got = fill(FrameReader(LIMITS), b"".join(written), [max(cut, 2_000)])
    assert sorted(got) == sorted(large + small)


@given(st.binary(max_size=400), st.integers(1, 100))
def test_garbage_never_does_more_than_raise(data: bytes, cut: int) -> None:
    reader = FrameReader(LIMITS, max_message=HANDSHAKE_SIZE)
    with suppress(ProtocolError):
        fill(reader, data, [cut])


@given(st.data())
def test_one_flipped_byte_never_does_more_than_raise(data: st.DataObject) -> None:
    written = bytearray(
        b"".join(fragments(Frame(FrameType.DATA, 1, 0, 0, bytes(40_000)), 9_000))
        + encode(Frame(FrameType.PING))
    )
    written[data.draw(st.integers(0, len(written) - 1))] ^= data.draw(st.integers(1, 255))
    with suppress(ProtocolError):
        fill(FrameReader(LIMITS), bytes(written), [3_000])


def test_large_payload_is_read_in_place() -> None:
    reader = FrameReader(LIMITS)
    frame = Frame(FrameType.DATA, 1, 0, LATCHED, bytes(range(256)) * 4_000)
    size = len(frame.payload)
    reader.feed(pack_header(frame, size, size))
    buffer = reader.get_buffer()
    assert len(buffer) == size - 1
    buffer[:] = frame.payload[:-1]
    assert reader.advance(size - 1) == []
    (got,) = reader.feed(frame.payload[-1:])
    assert got == frame
    assert type(got.payload) is bytes
    assert got.flags == LATCHED


@given(
    st.lists(LARGE, min_size=1, max_size=4, unique_by=lambda frame: frame.channel),
    st.integers(0, 12),
    st.integers(1, 300_000),
    st.lists(st.sampled_from([1_000, 4_000, 70_000, 10**6]), min_size=1, max_size=3),
)
def test_dropped_messages_are_passed_over_and_others_come(
    frames: list[Frame], when: int, size: int, cuts: list[int]
) -> None:
    reader = FrameReader(LIMITS)
    parts = [fragments(frame, 10_000) for frame in frames]
    written = [part for turn in zip_longest(*parts, fillvalue=b"") for part in turn if part]
    got = fill(reader, b"".join(written[:when]), cuts)
    before = reader.held_bytes
    dropped = reader.drop_unfinished(size)
    assert reader.held_bytes == before - sum(len(frames_of(frames, first).payload) for first in dropped)
    assert reader.held_bytes <= max(0, before - size)
    got += fill(reader, b"".join(written[when:]), cuts)
    channels = {first.channel for first in dropped}
    assert sorted(got) == sorted(frame for frame in frames if frame.channel not in channels)
    assert reader.held_bytes == 0
    assert fill(reader, b"".join(map(encode, frames)), cuts) == frames, "the channels can be used again"


def frames_of(frames: list[Frame], first: Frame) -> Frame:
    return next(frame for frame in frames if frame.channel == first.channel)


def test_a_dropped_message_keeps_no_memory_while_its_rest_comes() -> None:
    reader = FrameReader(LIMITS)
    first, second, third = fragments(Frame(FrameType.DATA, 1, 0, 0, b"x" * 1_200_000), 400_000)
    assert reader.feed(first) == []
    assert reader.held_bytes == 1_200_000
    (message,) = reader._unfinished.values()
    assert [frame.channel for frame in reader.drop_unfinished(1)] == [1]
    assert reader.held_bytes == 0
    assert len(message._buffer.getbuffer()) == 0
    assert reader.drop_unfinished(1) == []
    assert reader.feed(second + third) == []


def test_a_dropped_message_may_be_aborted() -> None:
    reader = FrameReader(LIMITS)
    frame = Frame(FrameType.DATA, 1, 0, 0, b"x" * 20_000)
    first, second = fragments(frame, 10_000)
    reader.feed(first)
    reader.drop_unfinished(1)
    assert reader.feed(encode(Frame(FrameType.ABORT, 1))) == []
    assert reader.held_bytes == 0
    assert reader.feed(first + second) == [frame]


def test_abort_drops_the_unfinished_message() -> None:
    reader = FrameReader(LIMITS)
    frame = Frame(FrameType.DATA, 1, 0, 0, b"x" * 20_000)
    first, second = fragments(frame, 10_000)
    assert reader.feed(first + encode(Frame(FrameType.ABORT, 1))) == []
    assert reader.feed(first + second) == [frame]


@pytest.mark.parametrize(
    "written",
    [
        HEADER.pack(99, 0, 0, 0, 0, 0, 0),
        HEADER.pack(FrameType.DATA, 0, 1, 0, 0, 0, 0),
        HEADER.pack(FrameType.DATA, 0, 0, 0, 0, 5, 4),
        HEADER.pack(FrameType.DATA, 0, 0, 0, 0, 10, LIMITS.max_message + 1),
        HEADER.pack(FrameType.DATA, 0, 0, 0, 0, 0, 10),
        HEADER.pack(FrameType.FRAGMENT, 0, 0, 0, 1, 4, 4) + b"abcd",
        HEADER.pack(FrameType.FRAGMENT, 0, 0, 0, 1, 0, 0),
        HEADER.pack(FrameType.FAULT, 0, 0, 0, 1, 20_000, 20_000),
        HEADER.pack(FrameType.PING, 0, 0, 0, 1, 1, 2) + b"x",
        encode(Frame(FrameType.ABORT, 1)),
        HEADER.pack(FrameType.DATA, 0, 0, 0, 1, 1, 2)
        + b"x"
        + HEADER.pack(FrameType.FRAGMENT, 0, 0, 0, 1, 2, 2),
        HEADER.pack(FrameType.DATA, 0, 0, 0, 1, 1, 3)
        + b"x"
        + HEADER.pack(FrameType.FRAGMENT, 0, 0, 0, 1, 1, 2),
        2 * (HEADER.pack(FrameType.DATA, 0, 0, 0, 1, 1, 2) + b"x"),
        b"".join(HEADER.pack(FrameType.DATA, 0, 0, 0, n, 1, 1_600_000) + b"x" for n in (1, 2)),
    ],
)
def test_broken_rules_are_refused(written: bytes) -> None:
    with pytest.raises(ProtocolError):
        FrameReader(LIMITS).feed(written)


def test_nothing_large_is_taken_before_the_handshake() -> None:
    reader = FrameReader(LIMITS, max_message=HANDSHAKE_SIZE)
    with pytest.raises(ProtocolError):
        reader.feed(HEADER.pack(FrameType.DATA, 0, 0, 0, 0, 10, HANDSHAKE_SIZE + 1))


def test_hello_round_trip() -> None:
    (frame,) = FrameReader(LIMITS).feed(encode_hello("link-1", "tökén"))
    hello = parse_hello(frame)
    assert (hello.link, hello.token) == ("link-1", "tökén")


@pytest.mark.parametrize(
    "frame",
    [
        Frame(FrameType.DATA),
        Frame(FrameType.HELLO, payload=b"\xff"),
        Frame(FrameType.HELLO, payload=b"{}"),
        Frame(FrameType.HELLO, payload=b'{"version":2,"link":"a","token":"b"}'),
    ],
)
def test_bad_hello_is_refused(frame: Frame) -> None:
    with pytest.raises(ProtocolError):
        parse_hello(frame)


def test_answers_to_hello() -> None:
    check_answer(Frame(FrameType.WELCOME))
    with pytest.raises(LinkRefusedError, match="not you"):
        check_answer(Frame(FrameType.REFUSE, payload=b"not you"))
    with pytest.raises(ProtocolError):
        check_answer(Frame(FrameType.DATA))


def test_missing_says_what_must_come() -> None:
    hello = encode_hello("a", "b")
    reader = FrameReader(LIMITS)
    assert reader.missing == HEADER.size
    reader.feed(hello[:10])
    assert reader.missing == HEADER.size - 10
    reader.feed(hello[10:30])
    assert reader.missing == len(hello) - 30


def test_a_closed_reader_lets_go_of_incomplete_messages() -> None:
    reader = FrameReader(LinkLimits())
    for channel in (1, 2):
        frame = Frame(FrameType.DATA, channel, payload=b"\0" * 50_000)
        reader.feed(pack_header(frame, 20_000, 50_000) + bytes(20_000))
    reader.feed(pack_fragment(1, 20_000, 50_000) + bytes(100))
    views = [message.view for message in reader._unfinished.values()]
    reader.close()
    for view in views:
        with pytest.raises(ValueError, match="released"):
            len(view)
