"""A WebSocket connection without a task between the network and the engine.

The ``websockets`` library does the handshake, the parsing, pings and the end of a connection. Two things
are different here, because the time they take is a large part of a message's way through the engine:

* A complete message is handed to the :class:`Receiver` from within ``data_received``; there is no queue
  and no task to be woken.
* Frames are written straight to the transport: a server's frames are neither masked nor compressed, so a
  header of 2 to 10 bytes goes out before the payload, which is not copied.

The rule for writing is the transport's own: write while :attr:`RobotSocket.writable`, then wait for
:meth:`Receiver.on_writable`.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from typing import TYPE_CHECKING, Protocol

from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import State

from rce.guard.websocket import GuardedConnection

if TYPE_CHECKING:
    import asyncio

    from websockets.protocol import Event

    from rce_robot.outbox import Buffer, Outgoing

LARGE_PART = 64 << 10
"""Bytes of an incomplete message from which on the receiver is told of every part."""

MAX_FRAGMENTS = 4096
"""Frames that one message may be split into."""

UNSENT_LOW_WATER = 256 << 10
"""Bytes that the kernel holds for a slow robot beyond what is on its way; more would only grow stale."""

_FIN_TEXT = 0x80 | Opcode.TEXT
_FIN_BINARY = 0x80 | Opcode.BINARY
_SHORT = struct.Struct("!BB")
_MEDIUM = struct.Struct("!BBH")
_TWO_BYTE_LENGTH, _EIGHT_BYTE_LENGTH = 126, 127
_LONG = struct.Struct("!BBQ")
_JOIN_BELOW = 16 << 10
"""Below this many bytes a copy costs less than another buffer in the transport's queue."""


class Receiver(Protocol):
    """What a :class:`RobotSocket` tells of. All methods are called in the event loop and must not block."""

    def on_text(self, text: bytes) -> None:
        """A text message came; not yet checked to be UTF-8."""

    def on_binary(self, data: bytes) -> None:
        """A binary message came."""

    def on_part(self) -> None:
        """A part of a large message came; :attr:`RobotSocket.held` grew."""

    def on_writable(self) -> None:
        """The connection takes messages again."""

    def on_lost(self, reason: str) -> None:
        """The connection ended. Called once, also when the handshake did not complete."""


class RobotSocket(GuardedConnection):
    """A robot's WebSocket connection."""

    receiver: Receiver | None = None
    """Gets what arrives. Set while the handshake is answered."""

    @property
    def held(self) -> int:
        """Bytes of a message that is not complete, and of those that the network has not taken yet, about."""
        return self._part_bytes + self._fragment_bytes + self.transport.get_write_buffer_size()

    @property
    def writable(self) -> bool:
        """Whether the connection is open and its write buffer below the limit."""
        return not self.paused and self.protocol.state is State.OPEN

    def write(self, message: Outgoing) -> None:
        """Write a message. Only to be called while :attr:`writable`."""
        buffers: list[Buffer] = []
        _add_frame(buffers, _FIN_TEXT, b"", message.text)
        for head, body in message.binaries:
            _add_frame(buffers, _FIN_BINARY, head, body)
        last = buffers.pop()
        if buffers:
            self.transport.writelines(buffers)
        # Python 3.12's and 3.13.0's writelines never calls pause_writing; write does, for all that waits.
        self.transport.write(last)

    def fail(self, code: int, reason: str) -> None:
        """Close the connection because of what the robot sent."""
        self._failed = True
        self._fragments.clear()
        self._part_bytes = self._fragment_bytes = 0
        if self.protocol.state is State.OPEN:
            self.protocol.fail(code, reason)
            self.send_data()

    def abort(self) -> None:
        """Drop the connection at once; the robot is not expected to answer any more."""
        self.transport.abort()

    # What the base class calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Prepare the socket for small and timely messages."""
        super().connection_made(transport)
        self._part_bytes = 0
        """Received since the last frame was complete."""
        self._fragments: list[bytes | bytearray] = []
        self._fragment_bytes = 0
        self._opcode = Opcode.TEXT
        self._failed = False
        sock = transport.get_extra_info("socket")
        if sock is not None and hasattr(socket, "TCP_NOTSENT_LOWAT") and sock.family != socket.AF_UNIX:
            # Without it megabytes of old images fill the kernel's buffer, where nothing can pass them.
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_LOW_WATER)

    def data_received(self, data: bytes) -> None:
        """Count what comes."""
        self._part_bytes += len(data)
        super().data_received(data)
        if self._part_bytes > LARGE_PART and self.receiver is not None and not self._failed:
            self.receiver.on_part()

    def process_event(self, event: Event) -> None:
        """Take complete data messages out of the base class's hands."""
        self._part_bytes = 0
        if type(event) is not Frame or event.opcode > Opcode.BINARY:
            super().process_event(event)
        elif event.fin and event.opcode is not Opcode.CONT:
            self._deliver(event.opcode, event.data)
        else:
            self._collect(event)

    def resume_writing(self) -> None:
        """Tell the receiver."""
        super().resume_writing()
        if self.receiver is not None:
            self.receiver.on_writable()

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell the receiver."""
        super().connection_lost(exc)
        if self.receiver is not None:
            self.receiver.on_lost(str(exc or self.close_exc))

    # Own

    def _collect(self, frame: Frame) -> None:
        if frame.opcode is not Opcode.CONT:
            self._opcode = frame.opcode
        self._fragments.append(bytes(frame.data))
        self._fragment_bytes += len(frame.data)
        if len(self._fragments) > MAX_FRAGMENTS:
            self.fail(CloseCode.MESSAGE_TOO_BIG, "too many fragments")
        elif frame.fin:
            data = b"".join(self._fragments)
            self._fragments.clear()
            self._fragment_bytes = 0
            self._deliver(self._opcode, data)

    def _deliver(self, opcode: Opcode, data: Buffer) -> None:
        if self._failed:
            return
        if self.receiver is None:
            self.fail(CloseCode.PROTOCOL_ERROR, "a message came before the handshake was answered")
        elif opcode is Opcode.TEXT:
            self.receiver.on_text(bytes(data))
        else:
            self.receiver.on_binary(bytes(data))


def _add_frame(buffers: list[Buffer], first: int, head: bytes, body: Buffer) -> None:
    """Append an unmasked frame (RFC 6455, section 5.2) of the payload ``head`` + ``body``."""
    size = len(head) + len(body)
    if size < _TWO_BYTE_LENGTH:
        header = _SHORT.pack(first, size)
    elif size < 1 << 16:
        header = _MEDIUM.pack(first, _TWO_BYTE_LENGTH, size)
    else:
        header = _LONG.pack(first, _EIGHT_BYTE_LENGTH, size)
    if size < _JOIN_BELOW:
        buffers.append(b"".join((header, head, body)))
    else:
        buffers.append(header + head)
        buffers.append(body)
