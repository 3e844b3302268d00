"""Large frames reach the parser's user in small steps, unmasked, in memory of their size."""

from __future__ import annotations

import random
import struct
from typing import TYPE_CHECKING

import pytest
from websockets.exceptions import ProtocolError
from websockets.frames import Frame, Opcode
from websockets.streams import StreamReader
from websockets.utils import apply_mask

from rce_robot.doors.client.steps import LARGE_FRAME, Steps

if TYPE_CHECKING:
    from collections.abc import Generator

MASK = b"\x01\x82\x43\xc4"


def masked(payload: bytes, opcode: int = Opcode.BINARY) -> bytes:
    size = len(payload)
    length = (
        struct.pack("!BBQ", 0x80 | opcode, 0xFF, size)
        if size >= LARGE_FRAME
        else struct.pack("!BB", 0x80 | opcode, 0x80 | size)
    )
    return length + MASK + bytes(byte ^ MASK[i % 4] for i, byte in enumerate(payload))


class Parser:
    """The library's parser with steps, as a connection drives it."""

    def __init__(self) -> None:
        self.reader = StreamReader()
        self.steps = Steps(self.reader)
        self.frames: list[tuple[int, bytes]] = []
        self.most_buffered = 0
        self.parsing = self._parse()
        self.go_on()

    def _parse(self) -> Generator[None, None, None]:
        while True:
            frame = yield from Frame.parse(self.reader.read_exact, mask=True)
            self.parsed.append(frame)

    def go_on(self, data: bytes = b"") -> None:
        """Give data, and turns as long as there is something to do."""
        self.reader.feed_data(data)
        while True:
            self.steps.allow()
            self.parsed: list[Frame] = []
            next(self.parsing)
            for frame in self.parsed:
                payload = self.steps.take()
                self.frames.append((frame.opcode, bytes(frame.data) if payload is None else payload))
            self.most_buffered = max(self.most_buffered, len(self.reader.buffer))
            if not self.steps.stopped:
                return


def test_frames_of_all_sizes_keep_content_and_order() -> None:
    rng = random.Random(5)
    payloads = [rng.randbytes(size) for size in (0, 3, LARGE_FRAME, 125, LARGE_FRAME + 1, 3 * LARGE_FRAME, 0)]
    stream = b"".join(map(masked, payloads))
    parser = Parser()
    start = 0
    while start < len(stream):
        size = rng.choice((1, 7, 1000, 70_001))
        parser.go_on(stream[start : start + size])
        start += size
    assert parser.frames == [(Opcode.BINARY, payload) for payload in payloads]


def test_no_more_than_a_read_is_buffered_or_unmasked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    def counted(data: bytearray, mask: bytes) -> bytes:
        sizes.append(len(data))
        return apply_mask(data, mask)

    monkeypatch.setattr("rce_robot.doors.client.steps.apply_mask", counted)
    read = 10_000
    stream = masked(bytes(50 * read))
    parser = Parser()
    for start in range(0, len(stream), read):
        parser.go_on(stream[start : start + read])
    assert parser.frames == [(Opcode.BINARY, bytes(50 * read))]
    assert max(sizes) <= read
    assert sum(sizes) == 50 * read
    assert parser.most_buffered <= read


def test_what_came_of_a_large_frame_is_counted() -> None:
    parser = Parser()
    stream = masked(bytes(2 * LARGE_FRAME))
    parser.go_on(stream[:-1])
    assert parser.steps.held == 2 * LARGE_FRAME - 1
    parser.go_on(stream[-1:])
    assert parser.steps.held == 0


def test_a_parser_that_is_given_up_lets_go_of_a_large_frame() -> None:
    parser = Parser()
    parser.go_on(masked(bytes(2 * LARGE_FRAME))[:-1])
    parser.parsing.close()
    assert parser.steps.held == 0


def test_an_end_within_a_large_frame_is_told() -> None:
    parser = Parser()
    parser.go_on(masked(bytes(LARGE_FRAME))[:-1])
    parser.reader.feed_eof()
    with pytest.raises(EOFError, match=f"stream ends after {LARGE_FRAME - 1} bytes, expected {LARGE_FRAME}"):
        next(parser.parsing)


def test_a_large_control_frame_is_refused_as_without_steps() -> None:
    parser = Parser()
    with pytest.raises(ProtocolError, match="control frame too long"):
        parser.go_on(masked(bytes(LARGE_FRAME), Opcode.PING))
