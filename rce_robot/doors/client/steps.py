"""Makes the ``websockets`` parser work in small steps, also on large frames.

The library collects a frame in one growing buffer, and copies it as a whole to unmask it. At 60 MB each of
the two blocks the event loop for tens of milliseconds. This module unmasks the payload of a large frame piece
by piece, as it arrives, directly into memory of its size. The parser gets an empty payload in its place; the
handler of the frame takes the real one from :meth:`Steps.take`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from websockets.frames import Opcode

from rce.buffers import unfilled

try:
    from websockets.speedups import apply_mask
except ImportError:  # the library was installed without its C extension
    from websockets.utils import apply_mask

if TYPE_CHECKING:
    from collections.abc import Generator

    from websockets.streams import StreamReader

LARGE_FRAME = 64 << 10
"""Size in bytes from which payloads bypass the parser. Their length always takes 8 bytes."""

READS_PER_STEP = 4
"""Reads of the parser before other users have their turn; a frame takes three or four."""


class Steps:
    """Lets a server's parser stop after a few frames; it continues with or without new data.

    Args:
        reader: The reader of the parser.
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
        """Whether the parser waits for the first byte of a frame."""
        reader.read_exact = self._read_exact  # type: ignore[method-assign]  # the library makes the reader
        reader.at_eof = self._at_eof  # type: ignore[method-assign]  # as above

    @property
    def held(self) -> int:
        """Bytes of the large payload that is being received, or was not taken yet."""
        return self._filled

    def allow(self, reads: int | None = READS_PER_STEP) -> None:
        """Allow a number of reads; None for any number, for a connection without turns."""
        self._left = math.inf if reads is None else reads
        self.stopped = False

    def take(self) -> bytes | None:
        """Return, once, the payload of the large frame that the parser passed on; None without one."""
        payload, self._payload = self._payload, None
        if payload is not None:
            self._filled = 0
        return payload

    def _at_eof(self) -> Generator[None, None, bool]:
        """Check for the end of the stream, which the parser does before each frame."""
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
        # A separate step: earlier data is handled first, and the payload before later data.
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
        """Read a payload of a size; an abandoned parser releases the received data."""
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
