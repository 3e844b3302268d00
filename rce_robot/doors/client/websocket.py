"""A WebSocket connection without a task between the network and the engine.

The ``websockets`` library does the handshake, the parsing, answers to pings and the end of a connection;
:class:`~rce.liveness.websocket.WatchedConnection` replaces its keepalive. Three things differ here, because
they take a large part of a message's time in the engine:

* A message in one frame is taken from the received data without the library's parser
  (:mod:`rce_robot.doors.client.frames`).
* A complete message is passed to the :class:`Receiver` from within ``data_received``, without a queue or a
  task.
* Frames are written directly to the transport: a server's frames are neither masked nor compressed, so a
  header of 2 to 10 bytes precedes the payload, which is not copied. In TLS they are written in pieces, so
  that :attr:`RobotSocket.held` counts what waits.

The rule for writing is the transport's own: write while :attr:`RobotSocket.writable`, then wait for
:meth:`Receiver.on_writable`.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import deque
from typing import TYPE_CHECKING, Protocol, cast

from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import State

from rce.buffers import unfilled, write_together
from rce.guard.websocket import GuardedConnection
from rce.liveness.websocket import WatchedConnection
from rce.tls.pieces import PiecewiseTransport
from rce_robot.doors.client.frames import (
    FIN_BINARY,
    FIN_TEXT,
    JOIN_BELOW,
    Pongs,
    add_frame,
    find_message,
)
from rce_robot.doors.client.steps import LARGE_FRAME, Steps

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from websockets.protocol import Event

    from rce.guard import LoopShare
    from rce_robot.outgoing import Buffer, Outgoing

LARGE_PART = LARGE_FRAME
"""Bytes of an incomplete message from which the receiver is notified of every part."""

MAX_FRAGMENTS = 4096
"""Frames that one message may be split into."""

JOIN_PER_STEP = 1 << 20
"""Bytes of a fragmented message that are joined before other users have their turn."""

UNSENT_LOW_WATER = 256 << 10
"""Unsent bytes that the kernel holds for a slow robot; more would only become stale."""


class Receiver(Protocol):
    """Receives the events of a :class:`RobotSocket`.

    All methods are called in the event loop and must not block.
    """

    def on_text(self, text: bytes) -> Iterator[None] | None:
        """Handle a text message that is not yet checked to be UTF-8.

        Returns:
            The remaining work, in steps between which others have their turns; None if it is done.
        """

    def on_binary(self, data: bytes) -> Iterator[None] | None:
        """Handle a binary message; the result is that of :meth:`on_text`."""

    def on_part(self) -> None:
        """Handle a part of a large message; :attr:`RobotSocket.held` grew."""

    def on_writable(self) -> None:
        """The connection accepts messages again."""

    def on_lost(self, reason: str) -> None:
        """The connection ended. Called once, also when the handshake did not complete."""


class RobotSocket(WatchedConnection, GuardedConnection):
    """A robot's WebSocket connection."""

    _share: LoopShare | None = None
    _user = ""
    _begin = 0
    """How much of the oldest received data has been handled."""
    _pieces: PiecewiseTransport | None = None
    """The transport, in TLS."""
    receiver: Receiver | None = None
    """Receives messages. Set while the handshake is answered."""

    @property
    def held(self) -> int:
        """Approximate bytes of an incomplete message, and of messages that the network has not taken yet."""
        parts = self._steps.held + self._fragment_bytes + self._work_bytes
        incomplete = len(self.protocol.reader.buffer) + self._input_bytes + parts
        return incomplete + self.transport.get_write_buffer_size()

    def write(self, message: Outgoing) -> None:
        """Write a message. Only to be called while :attr:`writable`."""
        buffers: list[Buffer] = []
        add_frame(buffers, FIN_TEXT, b"", message.text)
        for head, body in message.binaries:
            add_frame(buffers, FIN_BINARY, head, body)
        self._write(buffers)

    def write_binary(self, head: bytes, body: Buffer) -> None:
        """Write a message that is one binary frame. Only to be called while :attr:`writable`."""
        buffers: list[Buffer] = []
        add_frame(buffers, FIN_BINARY, head, body)
        self._write(buffers)

    def _write(self, buffers: list[Buffer]) -> None:
        if len(buffers) > 1 and sum(map(len, buffers)) < JOIN_BELOW:
            self.transport.write(b"".join(buffers))  # one system call, and in TLS one record
            return
        if len(buffers) > 1:
            write_together(self.transport, buffers)
        else:
            self.transport.write(buffers[0])

    def fail(self, code: int, reason: str) -> None:
        """Close the connection because of what the robot sent."""
        self._failed = True
        self._fragments.clear()
        self._fragment_bytes = 0
        self._forget_work()
        self._forget_input()
        self.end_soon()  # first: over TLS, sending a close frame closes the transport, which may take long
        if self.protocol.state is State.OPEN:
            self.protocol.fail(code, reason)
            self.send_data()

    async def close(self, code: CloseCode | int = CloseCode.NORMAL_CLOSURE, reason: str = "") -> None:
        """Close the connection; return when it has ended, after the close timeout at the latest."""
        self.end_soon()  # the library's time limit does not include the wait until the robot takes data
        await super().close(code, reason)

    def abort(self) -> None:
        """Drop the connection at once, without waiting for the robot."""
        self.transport.abort()

    async def probe(self, timeout_s: float) -> bool:
        """Ping the robot; return whether any data comes from it within ``timeout_s`` seconds.

        A robot whose program does not read answers no ping, but its messages show that it is there.
        """
        before = self._data_count
        self._data_came.clear()
        with contextlib.suppress(TimeoutError, ConnectionClosed):
            async with asyncio.timeout(timeout_s):
                await self.ping()
                await self._data_came.wait()
        return self._data_count != before and self.protocol.state is State.OPEN

    def share_loop(self, share: LoopShare, user: str) -> None:
        """Handle received data in the turns of this user from now on."""
        self._share = share
        self._user = user

    def continue_work(self) -> bool:
        """Handle a few received frames, or a part of a large one; return whether there is more."""
        if self._work:
            self._work_on()
            return True
        data = self._input.popleft() if self._input else b""
        if not self._take_message(data):
            rest = data[self._begin :] if self._begin else data
            self._begin = 0
            self._input_bytes -= len(rest)
            self._steps.allow()
            super().data_received(rest)
            if self.protocol.state is not State.OPEN:
                self.end_soon()
        if self._input or self._steps.stopped or self._work:
            return True
        self._end_of_input()
        return False

    # Called by the watch

    def heard(self) -> bool:
        """Return whether data came since the last call, or came before and waits for its turn."""
        return super().heard() or self._waits

    def give_up(self, silent: float) -> None:
        """End the connection, which has been silent for so many seconds."""
        self.fail(CloseCode.INTERNAL_ERROR, f"no sign of life for {silent:.0f} s")

    # Called by the base class

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Prepare the socket for small and timely messages."""
        if transport.get_extra_info("sslcontext") is not None:
            tls = cast("asyncio.Transport", transport)  # uvloop's only behave like one
            transport = self._pieces = PiecewiseTransport(tls, lambda: self.paused)
        self._pongs = Pongs()
        super().connection_made(transport)
        self._input: deque[bytes] = deque()
        """Data received while it was not this user's turn."""
        self._input_bytes = 0
        self._waits = False
        """Whether the connection waits for its turn."""
        self._data_count = 0
        """How often data came."""
        self._data_came = asyncio.Event()
        self._paused_reading = False
        self._eof = False
        self._steps = Steps(self.protocol.reader)
        self._fragments: list[bytes] = []
        self._fragment_bytes = 0
        self._opcode = Opcode.TEXT
        self._work: deque[tuple[Iterator[None], int]] = deque()
        """Messages that are handled in steps, with their sizes; those behind them wait."""
        self._work_bytes = 0
        self._failed = False
        sock = transport.get_extra_info("socket")
        if sock is not None and hasattr(socket, "TCP_NOTSENT_LOWAT") and sock.family != socket.AF_UNIX:
            # Without it megabytes of old images fill the kernel's buffer, where other messages cannot
            # overtake them.
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_LOW_WATER)

    def data_received(self, data: bytes) -> None:
        """Handle received data, now or when it is the user's turn."""
        self._has_heard = True
        self._data_count += 1
        self._data_came.set()
        if self._share is None:
            self._steps.allow(None)
            super().data_received(data)
            return
        if self._failed:
            data = b""
        self._input.append(data)
        self._input_bytes += len(data)
        if self._waits:
            return
        self._waits = True
        if not self._share.run(self._user, self) and not self.transport.is_closing():
            self._paused_reading = True
            self.transport.pause_reading()
        if self._steps.held > LARGE_PART and self.receiver is not None and not self._failed:
            self.receiver.on_part()

    def eof_received(self) -> bool | None:  # type: ignore[override]  # true keeps the transport, says asyncio
        """First handle data received before the end; over TLS only data with a turn before the close."""
        if not self._waits:
            super().eof_received()
            return None
        self._eof = True
        return self.transport.get_extra_info("sslcontext") is None  # a TLS transport cannot be kept

    def process_event(self, event: Event) -> None:
        """Handle complete data messages in place of the base class."""
        if type(event) is not Frame or event.opcode > Opcode.BINARY:
            super().process_event(event)
            return
        data = self._steps.take()
        if data is None:
            data = bytes(event.data)
        if event.fin and event.opcode is not Opcode.CONT:
            self._deliver(event.opcode, data)
        else:
            self._collect(event, data)

    def send_data(self) -> None:
        """Write the library's frames, without answers to pings that will not be read."""
        self.protocol.writes = self._pongs.take(self.protocol.writes, writable=not self.paused)
        super().send_data()

    def resume_writing(self) -> None:
        """Answer the newest ping, and tell the receiver."""
        super().resume_writing()
        if self._pieces is not None:
            self._pieces.resume_sending()
            if self.paused:
                return
        if (pong := self._pongs.pop()) and self.protocol.state is State.OPEN:
            self.transport.write(pong)
        if self.receiver is not None:
            self.receiver.on_writable()

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell the receiver."""
        self._forget_work()
        self._forget_input()
        if self._pieces is not None:
            self._pieces.forget()
        self._steps.allow(None)
        if self._share is not None:
            self._share.forget(self._user, self)
        super().connection_lost(exc)
        if self.receiver is not None:
            self.receiver.on_lost(str(exc or self.close_exc))

    # Private

    def _take_message(self, data: bytes) -> bool:
        """Handle the next frame without the library, if it is a message; return whether it is."""
        protocol = self.protocol
        if not self._steps.is_between_frames or protocol.current_size is not None:
            return False
        if protocol.state is not State.OPEN or protocol.extensions:
            return False
        begin = self._begin
        limit = protocol.max_message_size
        found = find_message(data, begin, len(data) if limit is None else limit)
        if found is None:
            return False
        opcode, message, end = found
        self._input_bytes -= end - begin
        if end < len(data):
            self._input.appendleft(data)
            self._begin = end
        else:
            self._begin = 0
        self._deliver(opcode, message)
        return True

    def _end_of_input(self) -> None:
        """Resume reading, because all received data has been handled."""
        self._waits = False
        if self._eof:
            self._eof = False
            super().eof_received()
            self.transport.close()
        elif self._paused_reading and not self.transport.is_closing():
            self.transport.resume_reading()
        self._paused_reading = False

    def _forget_input(self) -> None:
        self._input.clear()
        self._begin = self._input_bytes = 0
        if self._steps.stopped:
            self.protocol.reader.buffer.clear()

    def _collect(self, frame: Frame, data: bytes) -> None:
        if frame.opcode is not Opcode.CONT:
            self._opcode = frame.opcode
        self._fragments.append(data)
        self._fragment_bytes += len(data)
        if self.protocol.current_size is not None:
            self.protocol.current_size = self._fragment_bytes  # it was not notified of large ones
        if len(self._fragments) > MAX_FRAGMENTS:
            self.fail(CloseCode.MESSAGE_TOO_BIG, "too many fragments")
        elif frame.fin:
            fragments, self._fragments = self._fragments, []
            size, self._fragment_bytes = self._fragment_bytes, 0
            if size < JOIN_PER_STEP:
                self._deliver(self._opcode, b"".join(fragments))
            else:
                self._add_work(self._join(self._opcode, fragments, size), size)

    def _join(self, opcode: Opcode, fragments: Sequence[bytes], size: int) -> Iterator[None]:
        memory = unfilled(size)
        filled = 0
        with memory.getbuffer() as view:
            for fragment in fragments:
                for start in range(0, len(fragment), JOIN_PER_STEP):
                    part = memoryview(fragment)[start : start + JOIN_PER_STEP]
                    view[filled : filled + len(part)] = part
                    filled += len(part)
                    if filled // JOIN_PER_STEP > (filled - len(part)) // JOIN_PER_STEP:
                        yield
        yield from self._handle(opcode, memory.getvalue())

    def _deliver(self, opcode: Opcode, data: bytes) -> None:
        if self._failed:
            return
        if self.receiver is None:
            self.fail(CloseCode.PROTOCOL_ERROR, "a message came before the handshake was answered")
        elif self._work:
            self._add_work(self._handle(opcode, data), len(data))
        elif (rest := self._receive(self.receiver, opcode, data)) is not None:
            self._add_work(rest, len(data))

    def _handle(self, opcode: Opcode, data: bytes) -> Iterator[None]:
        if self.receiver is not None and (rest := self._receive(self.receiver, opcode, data)) is not None:
            yield from rest

    @staticmethod
    def _receive(receiver: Receiver, opcode: Opcode, data: bytes) -> Iterator[None] | None:
        return receiver.on_text(data) if opcode is Opcode.TEXT else receiver.on_binary(data)

    def _add_work(self, work: Iterator[None], size: int) -> None:
        self._work.append((work, size))
        self._work_bytes += size

    def _work_on(self) -> None:
        """Do a step of the oldest message."""
        work, size = self._work[0]
        for _ in work:
            return
        if self._work and self._work[0][0] is work:  # else the connection failed
            self._work.popleft()
            self._work_bytes -= size

    def _forget_work(self) -> None:
        self._work.clear()
        self._work_bytes = 0
