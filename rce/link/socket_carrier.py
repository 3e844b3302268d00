"""Carries frames over a unix or TCP socket: a thin shell around :mod:`frames` and :mod:`lanes`."""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import TYPE_CHECKING, TypeVar, cast

from rce.buffers import write_together
from rce.link.carrier import Carrier, CarrierHandler
from rce.link.exceptions import LinkLostError, ProtocolError
from rce.link.flow_control import FlowControl
from rce.link.frame_reader import FrameReader
from rce.link.frames import FRAGMENT_SIZE, HANDSHAKE_SIZE, Frame, FrameType, encode
from rce.link.lanes import Chunk, Lanes, frame_chunk
from rce.link.settings import KIB, MIB, LinkLimits, LinkTimeouts

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.link.pacing import Pacer
    from rce.link.queues import OutgoingQueue

T = TypeVar("T")
_log = logging.getLogger(__name__)

_HIGH_WATER = 64 * KIB
_LOW_WATER = 16 * KIB
"""So little lies in the transport's buffer that urgent frames wait for a fragment or two only."""
_NOT_SENT = 128 * KIB
"""Most unsent bytes of a TCP link in the kernel, for the same reason."""
_TURN = 1 * MIB
"""Bytes after which a link that could continue writing lets the event loop do something else."""


class SocketCarrier(asyncio.BufferedProtocol, Carrier):
    """A link's connection over a socket, from its first byte on.

    Until :meth:`start` only small frames are accepted, and kept; :meth:`handshake_frame` returns the first of
    them.

    Args:
        limits: Of links.
        timeouts: Of links.
        received: What was read of the connection already.
        max_early: How many frames may come after the first until :meth:`start`; None: as many as a link may
            have channels, which an accepting end opens right after its answer.
        on_open: Called when the connection is there.
        on_closed: Called when it has ended.

    Attributes:
        sent: Bytes that went out, with headers and the handshake.
        received: Bytes that came in, likewise.
    """

    def __init__(
        self,
        limits: LinkLimits,
        timeouts: LinkTimeouts,
        *,
        received: bytes = b"",
        max_early: int | None = None,
        on_open: Callable[[SocketCarrier], None] = lambda _: None,
        on_closed: Callable[[SocketCarrier], None] = lambda _: None,
    ) -> None:
        self._limits = limits
        self._timeouts = timeouts
        self._received = received
        self._max_early = limits.max_channels if max_early is None else max_early
        self._on_open = on_open
        self._on_closed = on_closed
        self._loop = asyncio.get_running_loop()
        self._reader = FrameReader(limits, max_message=HANDSHAKE_SIZE)
        self._lanes = Lanes(limits)
        self._transport: asyncio.Transport | None = None
        self._kind = ""
        self._writable = False
        self._straight = False
        """Writable, and without a limit: a message is sent at once if none waits before it."""
        self._flow: FlowControl | None = None
        self.sent = 0
        self.received = 0
        self._handler: CarrierHandler | None = None
        self._early: list[Frame] = []
        self._first: asyncio.Future[None] = self._loop.create_future()
        self._closed: asyncio.Future[None] = self._loop.create_future()
        self._ending = False
        self._reason: Exception | None = None
        self._heard = 0.0
        self._beat = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._turn: asyncio.Handle | None = None

    # The handshake

    async def handshake_frame(self) -> Frame:
        """Wait for the peer's first frame.

        Raises:
            ProtocolError: The peer sent something other than frames.
            LinkLostError: The connection ended first.
        """
        await asyncio.shield(self._first)
        if not self._early:
            raise self._reason or LinkLostError("the connection ended before the handshake")
        return self._early.pop(0)

    @property
    def peer(self) -> object:
        """The peer's address, as sockets say it; none before the connection is there."""
        return None if self._transport is None else self._transport.get_extra_info("peername")

    def greet(self, frame: bytes) -> None:
        """Send an encoded frame of the handshake."""
        if self._transport is not None and not self._ending:
            self._write((frame,))

    # Carrier

    @property
    def kind(self) -> str:
        """``unix`` or ``tcp``."""
        return self._kind

    def start(self, handler: CarrierHandler) -> None:
        """Begin to hand frames over; the handshake is done."""
        self._handler = handler
        self._reader.max_message = self._limits.max_message
        if self._kind == "tcp":
            self._heartbeat()
        early, self._early = self._early, []
        if self._ending:
            reason = self._reason or LinkLostError("the connection ended")
            self._loop.call_soon(handler.carrier_lost, self, reason)
        else:
            self._dispatch(early)

    def pace(self, pacer: Pacer | None) -> None:
        """Limit what passes."""
        if not self._ending and (pacer is not None or self._flow is not None):
            self._use_flow_control().pace(pacer)
            self._check_flow()

    @property
    def traffic(self) -> tuple[int, int]:
        """Bytes that came in and that went out."""
        return self.received, self.sent

    @property
    def unfinished_bytes(self) -> int:
        """Bytes that are set aside for messages that have not come as a whole yet."""
        return 0 if self._ending else self._reader.held_bytes

    def drop_unfinished(self, size: int) -> list[Frame]:
        """Forget the oldest messages that have not come as a whole yet; the connection continues."""
        return [] if self._ending else self._reader.drop_unfinished(size)

    def control(self, frame: Frame) -> None:
        """Send a small frame of the link itself."""
        if self._ending or self._transport is None:
            return
        if self._straight and not self._lanes:
            self._write((encode(frame),))
            return
        try:
            self._lanes.add_control(frame)
        except ProtocolError as error:
            self.abort(error)
        else:
            self.resume_sending()

    def send(self, queue: OutgoingQueue, frame: Frame) -> None:
        """Send a message: at once where nothing waits, else in its lane."""
        transport = self._transport
        if self._ending or transport is None:
            return
        size = len(frame.payload)
        if self._straight and size <= FRAGMENT_SIZE and not self._lanes:
            queue.counters.count_frame(frame)
            self._write(frame_chunk(frame))
            return
        self._lanes.add(queue, frame)
        self.resume_sending()

    def withdraw(self, queue: OutgoingQueue, call_id: int) -> bool:
        """Take a call back of which a part at least has not been sent."""
        withdrawn = self._lanes.withdraw(queue, call_id)
        self.resume_sending()
        return withdrawn

    def clear(self, queue: OutgoingQueue) -> None:
        """Throw away what waits on a channel."""
        self._lanes.clear(queue)
        self.resume_sending()

    def close(self) -> None:
        """Hang up after what lies in the socket's buffer was sent, or after the flush time."""
        self._handler = None
        self._end(LinkLostError("closed"), flush=True)

    def abort(self, reason: Exception) -> None:
        """End at once; the handler is told the reason."""
        if isinstance(reason, ProtocolError):
            _log.warning("link dropped: %s", reason)
        self._end(reason, flush=False)

    async def wait_closed(self) -> None:
        """Wait until the socket is closed."""
        await asyncio.shield(self._closed)

    # asyncio.BufferedProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the socket."""
        self._transport = cast("asyncio.Transport", transport)
        if self._ending:
            self._transport.abort()
            return
        self._transport.set_write_buffer_limits(high=_HIGH_WATER, low=_LOW_WATER)
        sock = transport.get_extra_info("socket")
        self._kind = "unix" if sock.family == socket.AF_UNIX else "tcp"
        if self._kind == "tcp":
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _NOT_SENT)
        self._writable = self._straight = True
        self._on_open(self)
        received, self._received = self._received, b""
        if received and not self._ending:
            self.received = len(received)
            self._take(self._reader.feed, received)

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002 - the reader knows better
        """Return where the socket's next bytes go."""
        buffer = self._reader.get_buffer()
        return buffer if self._flow is None else buffer[: self._flow.read_size]

    def buffer_updated(self, nbytes: int) -> None:
        """Take bytes of the socket."""
        self.received += nbytes
        self._take(self._reader.advance, nbytes)
        if self._flow is not None and not self._ending:
            self._flow.count_received()

    def pause_writing(self) -> None:
        """Stop handing bytes to the transport."""
        self._writable = self._straight = False

    def resume_writing(self) -> None:
        """Continue handing bytes to the transport."""
        self._writable = True
        self._straight = self._flow is None
        self.resume_sending()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give everything up."""
        self._end(exc or LinkLostError("the peer hung up"), flush=False)
        if self._timer is not None:
            self._timer.cancel()
        self._transport = None
        self._reader.close()
        self._closed.set_result(None)
        self._on_closed(self)

    # rce.link.flow_control.Stream

    def resume_sending(self) -> None:
        """Send waiting frames, as far as the socket and the limits allow."""
        if self._writable and self._turn is None:
            self._pump()

    def pause_reading(self) -> None:
        """Leave incoming bytes in the kernel's buffers."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Read again."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.resume_reading()

    # Inside

    def _use_flow_control(self) -> FlowControl:
        if self._flow is None:
            self._flow = FlowControl(self)
            self._straight = False
        return self._flow

    def _check_flow(self) -> None:
        """Remove the flow control when neither end has a limit any more."""
        if self._flow is not None and self._flow.open:
            self._flow = None
            self._straight = self._writable

    def _take(self, read: Callable[[T], list[Frame]], argument: T) -> None:
        self._heard = self._loop.time()
        held = self._reader.held_bytes
        try:
            frames = read(argument)
        except ProtocolError as error:
            self.abort(error)
            return
        if self._reader.held_bytes > held and self._handler is not None:
            self._handler.grew()
        if frames:
            self._dispatch(frames)

    def _dispatch(self, frames: list[Frame]) -> None:
        for frame in frames:
            if self._ending:
                return
            if self._handler is None:
                self._keep(frame)
            elif frame.type is FrameType.PING:
                self.control(Frame(FrameType.PONG))
            elif frame.type is FrameType.GRANT:
                self._take_grant(frame)
            elif frame.type is not FrameType.PONG:
                try:
                    self._handler.frame_received(frame)
                except ProtocolError as error:
                    self.abort(error)

    def _take_grant(self, frame: Frame) -> None:
        try:
            self._use_flow_control().allow(frame.payload)
        except ProtocolError as error:
            self.abort(error)
        else:
            self._check_flow()

    def _keep(self, frame: Frame) -> None:
        if len(self._early) > self._max_early:
            self.abort(ProtocolError("too many frames before the handshake is done"))
            return
        self._early.append(frame)
        if not self._first.done():
            self._first.set_result(None)

    def _pump(self) -> None:
        """Hand frames to the transport until its buffer is full enough, or a limit is reached."""
        self._turn = None
        budget = _TURN
        while self._lanes and self._writable and not self._ending:
            chunk = self._lanes.next() if self._flow is None else self._next_through(self._flow)
            if chunk is None:
                return
            budget -= self._write(chunk)
            if budget <= 0:
                self._turn = self._loop.call_soon(self._pump)
                return

    def _next_through(self, flow: FlowControl) -> Chunk | None:
        """Return the next frame that may be sent, paid for. Frames of the link itself never wait."""
        urgent = self._lanes.control or self._lanes.urgent
        limit = FRAGMENT_SIZE if self._lanes.control else flow.room(urgent=urgent)
        chunk = self._lanes.next(limit) if limit else None
        if chunk is not None:
            flow.count_sent(sum(map(len, chunk)), urgent=urgent)
        return chunk

    def _write(self, chunk: Chunk) -> int:
        assert self._transport is not None
        size = sum(map(len, chunk))
        self.sent += size
        if len(chunk) > 1:
            write_together(self._transport, chunk)
        else:
            self._transport.write(chunk[0])
        return size

    def _heartbeat(self) -> None:
        """Send a PING to a silent peer; end the carrier if the peer was silent for too long."""
        now = self._loop.time()
        stood_still = now - self._beat > 2 * self._timeouts.heartbeat  # or this is the first beat
        paused = self._flow is not None and self._flow.paused
        if stood_still or paused:
            self._heard = now  # this end read nothing: the peer may have sent something
        self._beat = now
        silent = now - self._heard
        if silent >= self._timeouts.silence:
            self.abort(LinkLostError(f"the peer was silent for {silent:.1f} s"))
            return
        if silent >= self._timeouts.heartbeat / 2 or paused:
            self.control(Frame(FrameType.PING))
        self._timer = self._loop.call_later(self._timeouts.heartbeat, self._heartbeat)

    def _end(self, reason: Exception, *, flush: bool) -> None:
        """Stop using the socket; the first reason counts."""
        if not self._ending:
            self._ending = True
            self._writable = self._straight = False
            if self._flow is not None:
                self._flow.close()
            self._reason = reason
            if self._turn is not None:
                self._turn.cancel()
            if self._timer is not None:
                self._timer.cancel()
            if not self._first.done():
                self._first.set_result(None)
            if self._transport is not None:
                self._hang_up(flush)
            if self._handler is not None:
                self._loop.call_soon(self._handler.carrier_lost, self, reason)

    def _hang_up(self, flush: bool) -> None:
        assert self._transport is not None
        if flush:
            self._transport.close()
            self._timer = self._loop.call_later(self._timeouts.flush, self._transport.abort)
        else:
            self._transport.abort()
