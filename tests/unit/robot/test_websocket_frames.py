"""Frames that are messages are read as the library reads them; all others are left to it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from rce_robot.doors.client.frames import FIN_BINARY, FIN_TEXT, add_frame, find_message

ANY_SIZE = 1 << 20
SIZES = [0, 1, 125, 126, 127, 65535, 65536, 70_000]


@given(
    st.sampled_from([Opcode.TEXT, Opcode.BINARY]),
    st.sampled_from(SIZES),
    st.binary(max_size=20),
    st.binary(max_size=20),
)
def test_a_whole_message_is_read(opcode: Opcode, size: int, before: bytes, after: bytes) -> None:
    payload = bytes(range(256)) * (size // 256 + 1)
    frame = Frame(opcode, payload[:size]).serialize(mask=True)
    found = find_message(before + frame + after, len(before), ANY_SIZE)
    assert found == (opcode, payload[:size], len(before) + len(frame))


@pytest.mark.parametrize("size", SIZES)
def test_a_message_that_has_not_come_whole_is_not_read(size: int) -> None:
    frame = Frame(Opcode.BINARY, bytes(size)).serialize(mask=True)
    for end in {*range(min(20, len(frame))), len(frame) // 2, len(frame) - 1}:
        assert find_message(b"ab" + frame[:end], 2, ANY_SIZE) is None


@pytest.mark.parametrize("size", SIZES[1:])
def test_a_message_over_the_limit_is_not_read(size: int) -> None:
    frame = Frame(Opcode.BINARY, bytes(size)).serialize(mask=True)
    assert find_message(frame, 0, size) is not None
    assert find_message(frame, 0, size - 1) is None


@pytest.mark.parametrize(
    "frame",
    [
        Frame(Opcode.TEXT, b"x", fin=False).serialize(mask=True),
        Frame(Opcode.CONT, b"x").serialize(mask=True),
        Frame(Opcode.PING, b"x").serialize(mask=True),
        Frame(Opcode.PONG, b"x").serialize(mask=True),
        Frame(Opcode.CLOSE, b"").serialize(mask=True),
        b"\xc1\x81" + bytes(4) + b"x",
        Frame(Opcode.BINARY, bytes(300)).serialize(mask=False),
        b"\x83\x80" + bytes(4),
    ],
    ids=["begun", "continued", "ping", "pong", "close", "extension", "not masked", "unknown"],
)
def test_other_frames_are_not_read(frame: bytes) -> None:
    assert find_message(frame, 0, ANY_SIZE) is None


@pytest.mark.parametrize("size", [*SIZES, 16_300, 16_400])
@pytest.mark.parametrize(("first", "opcode"), [(FIN_TEXT, Opcode.TEXT), (FIN_BINARY, Opcode.BINARY)])
def test_frames_are_written_as_the_library_does(first: int, opcode: Opcode, size: int) -> None:
    buffers: list[bytes | bytearray | memoryview] = []
    add_frame(buffers, first, b"head", bytes(size))
    assert b"".join(buffers) == Frame(opcode, b"head" + bytes(size)).serialize(mask=False)
