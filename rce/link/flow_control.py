"""How much may pass on one connection, when this end's endpoint or the peer's has a limit.

Sending is paced. Incoming bytes cannot be reordered once they are in the kernel's buffers, so the limited end
says in advance how far its peer may send: a GRANT frame holds an offset in the stream of bytes, counted from
the beginning of the connection. The peer's bulk messages wait in the peer's own queues, which drop the oldest
of them when full; its small messages continue. A peer that sends much more than was granted is not read from
until that is paid.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Protocol

from rce.link.exceptions import ProtocolError
from rce.link.frames import FRAGMENT_SIZE, Frame, FrameType
from rce.link.queues import SMALL_MESSAGE

if TYPE_CHECKING:
    from rce.link.pacing import Pacer

_OFFSET = struct.Struct("!Q")
_NO_LIMIT = 2**64 - 1


class Stream(Protocol):
    """The connection that a flow control belongs to.

    Attributes:
        sent: Bytes since its beginning.
        received: Likewise.
    """

    sent: int
    received: int

    def control(self, frame: Frame) -> None:
        """Send a frame of the link itself."""

    def resume_sending(self) -> None:
        """Send what waits."""

    def pause_reading(self) -> None:
        """Leave incoming bytes in the kernel's buffers."""

    def resume_reading(self) -> None:
        """Take :meth:`pause_reading` back."""


class FlowControl:
    """The limits of one connection.

    Invariant: every byte up to the granted offset was paid for when it was granted.

    Attributes:
        paused: Whether nothing is read at present.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._pacer: Pacer | None = None
        self._granted = 0
        """Offset up to which the peer may send bulk, and which was paid for."""
        self._allowed = _NO_LIMIT
        """Offset up to which this end may send bulk."""
        self.paused = False

    @property
    def open(self) -> bool:
        """Whether neither end has a limit."""
        return self._pacer is None and self._allowed == _NO_LIMIT

    def pace(self, pacer: Pacer | None) -> None:
        """Set this end's limit."""
        if pacer is self._pacer:
            return
        self.close()
        self._pacer = pacer
        if pacer is not None:
            self._granted = self._stream.received
            self._send_grant(self._granted)
            self._extend()
        else:
            self._send_grant(_NO_LIMIT)
        self._stream.resume_sending()

    def allow(self, payload: bytes | memoryview) -> None:
        """Take the peer's GRANT.

        Raises:
            ProtocolError: The frame is not a GRANT.
        """
        if len(payload) != _OFFSET.size:
            raise ProtocolError("bad GRANT")
        (self._allowed,) = _OFFSET.unpack(payload)
        self._stream.resume_sending()

    def room(self, *, urgent: bool) -> int:
        """Return how many bytes of payload the next frame may have; for 0, the stream continues later."""
        limit = FRAGMENT_SIZE
        if self._allowed != _NO_LIMIT:
            left = self._allowed - self._stream.sent
            if left <= 0 and not urgent:
                return 0
            limit = min(limit, max(left, SMALL_MESSAGE))
        if self._pacer is not None:
            if not self._pacer.ask(self._stream.resume_sending, urgent=urgent):
                return 0
            limit = min(limit, self._pacer.part)
        return limit

    def count_sent(self, size: int, *, urgent: bool) -> None:
        """Count a frame."""
        if self._pacer is not None:
            self._pacer.spend(size, urgent=urgent)

    @property
    def read_size(self) -> int:
        """Most bytes to be read at once."""
        return FRAGMENT_SIZE if self._pacer is None else self._pacer.part

    def count_received(self) -> None:
        """Count incoming bytes; stop reading if they are far more than was granted."""
        pacer = self._pacer
        if pacer is None:
            return
        excess = self._stream.received - self._granted
        if excess > 0:
            self._granted = self._stream.received
            pacer.spend(excess, urgent=True)
            if not self.paused and not pacer.ask(self._read_on, urgent=True):
                self.paused = True
                self._stream.pause_reading()
        self._extend()

    def close(self) -> None:
        """Stop waiting for the limit."""
        if self._pacer is not None:
            for go in (self._extend, self._read_on, self._stream.resume_sending):
                self._pacer.forget(go)
        self._read_on()

    def _extend(self) -> None:
        """Grant and pay the next bytes, once half of those that were granted have come."""
        pacer = self._pacer
        assert pacer is not None
        left = self._granted - self._stream.received
        if left <= pacer.burst // 2 and pacer.ask(self._extend, urgent=False):
            pacer.spend(pacer.burst - left, urgent=False)
            self._granted += pacer.burst - left
            self._send_grant(self._granted)

    def _send_grant(self, offset: int) -> None:
        self._stream.control(Frame(FrameType.GRANT, payload=_OFFSET.pack(offset)))

    def _read_on(self) -> None:
        if self.paused:
            self.paused = False
            self._stream.resume_reading()
