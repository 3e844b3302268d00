"""One TCPROS socket: frames in, frames out, with back-pressure.

A connection knows nothing of topics and services: its owner takes the frames and writes others.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Protocol, cast

from rce.buffers import write_together
from rce.dialing import set_keepalive
from rce.ros.errors import TcprosError
from rce.ros.tcpros.framing import MAX_FRAME, Chunks, FrameReader
from rce.ros.tcpros.header import MAX_HEADER

if TYPE_CHECKING:
    from rce.ros.closing import OpenConnections

_log = logging.getLogger(__name__)

LARGE_MESSAGE = 2**16
"""From this length on, a message's memory is worth keeping (see :mod:`rce.ros.tcpros.allocator`)."""

WRITE_HIGH = 2**16
"""The connection is full when more bytes than this wait to be sent."""


class Owner(Protocol):
    """The receiver of a connection's frames."""

    def connection_made(self, connection: Connection) -> None:
        """Take note that the connection was made."""

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        """Take a frame.

        Raises:
            TcprosError: The connection cannot continue and shall be closed.
        """

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        """Take note that the connection is gone."""

    def writable(self, connection: Connection) -> None:
        """Take note that a full connection takes more again."""


class Connection(asyncio.BufferedProtocol):
    """A TCPROS connection in either direction.

    Attributes:
        owner: Takes the frames; may be exchanged, as when the header told what the connection is for.
        full: Whether too much waits to be sent already. Writing is still possible, but should wait.
        bytes_in: Bytes of frames received, without their heads.
        gone: Set when the socket is closed.
    """

    def __init__(
        self, owner: Owner, scratch: memoryview, *, siblings: OpenConnections[Connection] | None = None
    ) -> None:
        """Make a connection for a transport.

        Args:
            owner: Takes the frames.
            scratch: Buffer shared by all connections of one event loop's node.
            siblings: The server's open connections, to which it adds itself.
        """
        self.owner = owner
        self.full = False
        self.bytes_in = 0
        self.gone = asyncio.Event()
        self.reader = FrameReader(scratch, limit=MAX_HEADER)
        self._siblings = siblings
        self._transport: asyncio.Transport | None = None
        self._closing = False
        self._large: bytes | None = None  # a frame that was set aside
        self._peer = "?"

    # For the owner

    @property
    def is_open(self) -> bool:
        """Whether frames can still be written."""
        return self._transport is not None and not self._closing

    def header_done(self, *, has_lead: bool = False) -> None:
        """Accept messages from now on: longer than headers and, from a service, with a lead byte."""
        self.reader.limit = MAX_FRAME
        self.reader.has_lead = has_lead

    def write(self, chunks: Chunks) -> None:
        """Send a frame; ignored when the connection is gone."""
        transport = self._transport
        if transport is None or self._closing:
            return
        if len(chunks) > 1:
            write_together(transport, chunks)
            self._learn_size(len(chunks[-1]))
        else:
            transport.write(chunks[0])

    def close(self) -> None:
        """Close once what was written is out."""
        self._closing = True
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close now; what was written may be lost."""
        self._closing = True
        if self._transport is not None:
            self._transport.abort()

    def pause_reading(self) -> None:
        """Stop reading from the peer."""
        if self._transport is not None and self._transport.is_reading():
            self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Read from the peer again."""
        if self._transport is not None and not self._transport.is_reading() and not self._closing:
            self._transport.resume_reading()

    def __str__(self) -> str:
        return f"TCPROS connection with {self._peer}"

    # For the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        self._transport = cast("asyncio.Transport", transport)  # uvloop's only behave like one
        self._transport.set_write_buffer_limits(high=WRITE_HIGH)
        self._peer = str(transport.get_extra_info("peername"))
        set_keepalive(transport.get_extra_info("socket"), idle=60, interval=10, count=9)  # as rospy, roscpp
        if self._siblings is not None:
            self._siblings.add(self)
        self.owner.connection_made(self)

    def connection_lost(self, error: Exception | None) -> None:
        """Tell the owner."""
        self._transport = None
        self.gone.set()
        if self._siblings is not None:
            self._siblings.discard(self)
        self.owner.connection_lost(self, error)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return where the next bytes go."""
        del sizehint  # the reader knows better
        self._set_large_aside()
        return self.reader.buffer()

    def buffer_updated(self, nbytes: int) -> None:
        """Hand the complete frames to the owner."""
        reader = self.reader
        reader.received(nbytes)
        try:
            self._hand_over_large()
            while not self._closing and (payload := reader.next_frame()) is not None:
                self._hand_over(payload)
        except TcprosError as error:
            self._fail(error)
        if reader.is_large_complete:
            # The transport still holds the frame's memory; taking the frame now would copy it.
            asyncio.get_running_loop().call_soon(self._take_large)

    def pause_writing(self) -> None:
        """Note that the peer takes less than was written."""
        self.full = True

    def resume_writing(self) -> None:
        """Tell the owner that there is room again."""
        self.full = False
        self.owner.writable(self)

    # Inside

    def _set_large_aside(self) -> None:
        """Set a complete large frame aside, to be handed over later.

        Not at once: the owner may close or pause the connection, which breaks uvloop's transports while they
        ask for a buffer.
        """
        if self.reader.is_large_complete:
            self._large = self.reader.take_large()
            self._learn_size(len(self._large))

    def _take_large(self) -> None:
        """Hand over a large frame, unless more was read since."""
        self._set_large_aside()
        try:
            self._hand_over_large()
        except TcprosError as error:
            self._fail(error)

    def _hand_over_large(self) -> None:
        payload, self._large = self._large, None
        if payload is not None and not self._closing:
            self._hand_over(payload)

    def _hand_over(self, payload: bytes) -> None:
        self.bytes_in += len(payload)
        self.owner.frame_received(self, payload)

    @staticmethod
    def _learn_size(size: int) -> None:
        if size >= LARGE_MESSAGE:
            from rce.ros.tcpros.allocator import keep_large_blocks

            keep_large_blocks()

    def _fail(self, error: TcprosError) -> None:
        _log.warning("%s is closed: %s", self, error)
        self.abort()
