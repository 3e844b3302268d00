"""Has the ``websockets`` parser work in small steps, also on frames that are large.

The library collects a frame in one buffer that grows, and copies it as a whole to take the mask off. At 60 MB
each of the two holds the event loop for tens of milliseconds. Here the payload of a large frame is unmasked
piece by piece, as it comes in, right into memory of its size. The parser gets an empty payload in its place;
what handles the frame takes the real one from :meth:`Steps.take`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from websockets.frames import Opcode

from rce.buffers import unfilled

try:
    from websockets.speedups import apply_mask
except ImportError:  # the library was installed without its part in C
    from websockets.utils import apply_mask

if TYPE_CHECKING:
    from collections.abc import Generator

    from websockets.streams import StreamReader

LARGE_FRAME = 64 << 10
"""Payloads from here on are taken out of the parser's hands, in bytes. Their length is always in 8 bytes."""

READS_PER_STEP = 4
"""Reads of the parser before others may have their turn; a frame takes three or four."""


class Steps:
    """Lets a server's parser stop after a few frames; it continues with the next data, or with none.

    Args:
        reader: Where the parser reads.
    """

    def __init__(self, reader: StreamReader) -> None:
        self._left: float = math.inf
        self._reader = reader
        self._read = reader.read_exact
        self._is_at_end = reader.at_eof
        self._header: deque[bytearray] = deque(maxlen=3)
        """The last small reads: before a large payload its first bytes, its length, its mask."""
        self._payload: bytes | None = None
        self._filled = 0
        self.stopped = False
        """Whether the parser could continue."""
        self.is_between_frames = False
        """Whether the parser waits for a frame of which it has nothing yet."""
        reader.read_exact = self._read_exact  # type: ignore[method-assign]  # the library makes the reader
        reader.at_eof = self._at_eof  # type: ignore[method-assign]  # as above

    @property
    def held(self) -> int:
        """Bytes of the large payload that is coming in, or was not taken yet."""
        return self._filled

    def allow(self, reads: int | None = READS_PER_STEP) -> None:
        """Let so many reads pass; None for any number, for a connection that takes no turns."""
        self._left = math.inf if reads is None else reads
        self.stopped = False

    def take(self) -> bytes | None:
        """Return the payload of the large frame that the parser handed on, once; None if there is none."""
        payload, self._payload = self._payload, None
        if payload is not None:
            self._filled = 0
        return payload

    def _at_eof(self) -> Generator[None, None, bool]:
        """Look for the end of the stream, which the parser does before each frame."""
        self.is_between_frames = True
        is_at_end = yield from self._is_at_end()
        self.is_between_frames = False
        return is_at_end

    def _read_exact(self, n: int) -> Generator[None, None, bytearray]:
        self._left -= 1
        yield from self._wait_for_turn()
        if n < LARGE_FRAME:
            data = yield from self._read(n)
            self._header.append(data)
            return data
        first, _, mask = self._header
        if self._left == math.inf or first[0] & 0x0F > Opcode.BINARY:  # the parser refuses it
            return (yield from self._read(n))
        # A step of its own: what came before is handled first, and the payload before what comes after.
        self._left = -1
        yield from self._wait_for_turn()
        self._payload = yield from self._unmasked(n, bytes(mask))
        self._left = 0
        return bytearray()

    def _wait_for_turn(self) -> Generator[None, None, None]:
        while self._left < 0:
            self.stopped = True
            yield

    def _unmasked(self, size: int, mask: bytes) -> Generator[None, None, bytes]:
        """Read a payload of a size; a parser that is given up lets go of what has come."""
        memory = unfilled(size)
        try:
            with memory.getbuffer() as view:
                while self._filled < size:
                    piece = yield from self._next_piece(size)
                    shift = self._filled % 4
                    end = self._filled + len(piece)
                    view[self._filled : end] = apply_mask(piece, mask[shift:] + mask[:shift])
                    self._filled = end
        except BaseException:
            self._filled = 0
            raise
        return memory.getvalue()

    def _next_piece(self, size: int) -> Generator[None, None, bytearray]:
        reader = self._reader
        while not reader.buffer:
            if reader.eof:
                raise EOFError(f"stream ends after {self._filled} bytes, expected {size} bytes")
            yield
        missing = size - self._filled
        piece = reader.buffer
        if len(piece) <= missing:
            reader.buffer = bytearray()
            return piece
        rest = piece[missing:]
        del piece[missing:]
        reader.buffer = rest
        return piece
