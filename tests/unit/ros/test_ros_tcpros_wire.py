"""TCPROS headers and frames, without sockets."""

from __future__ import annotations

import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rce.ros.errors import HandshakeRefusedError, MalformedFrameError
from rce.ros.tcpros.framing import LARGE, FrameReader, answer_frame, frame
from rce.ros.tcpros.header import check_type, decode_header, encode_header, require

NAME = st.from_regex(r"[a-z_]{1,10}", fullmatch=True)


@given(st.dictionaries(NAME, st.text()))
def test_headers_survive(fields: dict[str, str]) -> None:
    encoded = encode_header(fields)
    assert struct.unpack_from("<I", encoded)[0] == len(encoded) - 4
    assert decode_header(encoded[4:]) == fields


def test_header_layout() -> None:
    assert encode_header({"a": "1"}) == b"\x07\0\0\0\x03\0\0\0a=1"


@given(st.binary(max_size=100))
@example(b"\xff\xff\xff\xff")
@example(b"\x01\0\0\0a")
def test_any_bytes_are_a_header_or_refused(body: bytes) -> None:
    try:
        decode_header(body)
    except MalformedFrameError:
        return
    assert not body or len(body) > 4


@pytest.mark.parametrize(("here", "there"), [("abc", "abc"), ("*", "abc"), ("abc", "*"), ("*", "*")])
def test_types_agree(here: str, there: str) -> None:
    check_type({"md5sum": there}, md5sum=here, type_name="a/B", subject="topic /t")


def test_types_disagree() -> None:
    with pytest.raises(
        HandshakeRefusedError, match=r"topic /t is of type a/B with md5 sum abc here, of type c/D"
    ):
        check_type({"md5sum": "xyz", "type": "c/D"}, md5sum="abc", type_name="a/B", subject="topic /t")


def test_missing_fields_are_named() -> None:
    with pytest.raises(HandshakeRefusedError, match="md5sum"):
        require({"callerid": "/a"}, "callerid", "md5sum")


def read(
    stream: bytes, steps: list[int], *, scratch: int = 64, lead: bool = False
) -> list[tuple[int, bytes]]:
    """Feed a stream in pieces, as a transport would."""
    reader = FrameReader(memoryview(bytearray(scratch)))
    reader.has_lead = lead
    found = []
    position = step = 0
    while position < len(stream):
        if reader.is_large_complete:
            found.append((reader.lead, reader.take_large()))
        room = reader.buffer()
        count = min(len(room), steps[step % len(steps)], len(stream) - position)
        assert count
        room[:count] = stream[position : position + count]
        room.release()
        position += count
        step += 1
        reader.received(count)
        while (payload := reader.next_frame()) is not None:
            found.append((reader.lead, payload))
    if reader.is_large_complete:
        found.append((reader.lead, reader.take_large()))
    return found


@given(
    st.lists(st.binary(max_size=300), max_size=8),
    st.lists(st.integers(1, 70), min_size=1),
    st.integers(8, 400),
)
def test_frames_survive_any_splitting(payloads: list[bytes], steps: list[int], scratch: int) -> None:
    stream = b"".join(b"".join(frame(payload)) for payload in payloads)
    assert [payload for _, payload in read(stream, steps, scratch=scratch)] == payloads


@given(
    st.lists(st.tuples(st.booleans(), st.binary(max_size=99)), max_size=8),
    st.lists(st.integers(1, 70), min_size=1),
)
def test_answers_survive_any_splitting(answers: list[tuple[bool, bytes]], steps: list[int]) -> None:
    stream = b"".join(b"".join(answer_frame(payload, ok=ok)) for ok, payload in answers)
    assert read(stream, steps, lead=True) == answers


def test_large_frames_grow_as_they_come() -> None:
    payload = bytes(range(256)) * 2**17  # 32 MiB: more than is trusted at once
    assert read(b"".join(frame(payload)), [2**22], scratch=2**17) == [(1, payload)]


def test_large_payloads_are_not_copied() -> None:
    payload = bytes(LARGE)
    assert frame(payload)[1] is payload


def test_frames_that_are_too_long_are_refused() -> None:
    reader = FrameReader(memoryview(bytearray(64)), limit=10)
    reader.buffer()[:4] = struct.pack("<I", 11)
    reader.received(4)
    with pytest.raises(MalformedFrameError, match="longer than 10"):
        reader.next_frame()
