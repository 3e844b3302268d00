"""Frames in a byte stream: a length (4 bytes, little-endian) and that many bytes. Sans-I/O.

A service's answer has one byte before the length, the *lead*, for success or error.

Reading is made for two kinds of traffic. Many small frames arrive in one read into a scratch buffer that all
connections of a node share, and are cut out of it. A large frame gets memory of its own as soon as its length
is known and is read straight into it; :class:`io.BytesIO` lends its memory to the socket and then hands it
over as ``bytes`` without a copy.
"""

from __future__ import annotations

import io
import struct

from rce.buffers import unfilled
from rce.ros.errors import MalformedFrameError

MAX_FRAME = 2**28
"""Longest message in bytes."""

SCRATCH_SIZE = 2**17
"""Size of the shared buffer in bytes: how much one read can bring in small frames."""

LARGE = 2**16
"""From this length on, a frame is written without joining it with its length first."""

_LENGTH = struct.Struct("<I")
_FIRST_TRUST = 2**24

Chunks = tuple[bytes, ...]
"""An outgoing frame, as buffers to write one after the other; all receivers share them."""


def frame(payload: bytes | bytearray | memoryview) -> Chunks:
    """Make a frame of a message or request. A large payload is not copied: do not change it afterwards."""
    length = _LENGTH.pack(len(payload))
    if len(payload) < LARGE:
        return (length + payload,)
    return (length, payload)  # type: ignore[return-value]


def payload_of(chunks: Chunks) -> bytes:
    """Return the payload of a frame made by :func:`frame`."""
    return chunks[1] if len(chunks) > 1 else chunks[0][_LENGTH.size :]


def answer_frame(payload: bytes | bytearray | memoryview, *, ok: bool) -> Chunks:
    """Make the frame of a service's answer: a response if ``ok``, else an error text."""
    head = (b"\x01" if ok else b"\x00") + _LENGTH.pack(len(payload))
    if len(payload) < LARGE:
        return (head + payload,)
    return (head, payload)  # type: ignore[return-value]


class FrameReader:
    """Cuts a byte stream into frames.

    Use: read into :meth:`buffer`, tell :meth:`received` how much came, then call :meth:`next_frame` until it
    returns ``None``. All of this must happen before another reader with the same scratch buffer is used.
    A frame with memory of its own is complete when :attr:`is_large_complete` says so; :meth:`take_large` then
    returns it, to be called when no reference to the memory of :meth:`buffer` is held any longer.

    Attributes:
        limit: Longest frame accepted; may be changed between frames.
        has_lead: Whether the next frame has a lead byte; may be changed between frames.
        lead: The lead byte of the frame that was returned last, 1 where frames have none.
    """

    def __init__(self, scratch: memoryview, *, limit: int = MAX_FRAME) -> None:
        self.limit = limit
        self.has_lead = False
        self.lead = 1
        self._scratch = scratch
        self._begin = 0  # what was read and not yet cut: scratch[begin:end]
        self._end = 0
        self._head = b""  # an incomplete frame head between two reads
        self._large: io.BytesIO | None = None  # a frame that is being read into memory of its own
        self._view = memoryview(b"")  # that memory
        self._have = 0
        self._need = 0

    @property
    def is_large_complete(self) -> bool:
        """Whether :meth:`take_large` has a frame to return."""
        return self._large is not None and self._have == self._need

    def buffer(self) -> memoryview:
        """Return the buffer for the next read."""
        if self._large is not None:
            if self._have == len(self._view):
                self._extend(min(self._need, 4 * self._have))
            return self._view[self._have :]
        kept = len(self._head)
        if kept:
            self._scratch[:kept] = self._head
        return self._scratch[kept:]

    def received(self, count: int) -> None:
        """Note that ``count`` bytes were read into :meth:`buffer`."""
        if self._large is not None:
            self._have += count
            return
        self._begin = 0
        self._end = len(self._head) + count
        self._head = b""

    def next_frame(self) -> bytes | None:
        """Return the next complete frame, without head.

        Raises:
            MalformedFrameError: A frame is longer than :attr:`limit`.
        """
        if self._large is not None:
            return None
        body = self._begin + (5 if self.has_lead else 4)
        if body > self._end:
            self._head = bytes(self._scratch[self._begin : self._end])
            self._begin = self._end
            return None
        length: int = _LENGTH.unpack_from(self._scratch, body - 4)[0]
        if length > self.limit:
            raise MalformedFrameError(f"a frame of {length} bytes is longer than {self.limit}")
        self.lead = self._scratch[self._begin] if self.has_lead else 1
        stop = body + length
        if stop > self._end:
            self._begin_large(body, length)
            return None
        self._begin = stop
        return bytes(self._scratch[body:stop])

    def take_large(self) -> bytes:
        """Return the frame that is complete in memory of its own."""
        assert self._large is not None
        self._view.release()
        payload = self._large.getvalue()  # copies while a reference to the memory is held
        self._large = None
        return payload

    def _begin_large(self, body: int, length: int) -> None:
        """Give an incomplete frame memory of its own and copy its received bytes there."""
        self._need = length
        self._have = self._end - body
        self._large = unfilled(min(length, max(_FIRST_TRUST, self._have)))
        self._view = self._large.getbuffer()
        self._view[: self._have] = self._scratch[body : self._end]
        self._begin = self._end

    def _extend(self, size: int) -> None:
        """Make the frame's memory ``size`` bytes long.

        A peer's length is trusted up to 16 MiB; beyond that, memory is added as the data arrives.
        """
        assert self._large is not None
        self._view.release()
        self._large.seek(size - 1)
        self._large.write(b"\0")
        self._view = self._large.getbuffer()
