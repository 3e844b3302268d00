"""One end of a connection: an interface's channel on a link."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, assert_never

from rce.aio.queues import OverflowPolicy
from rce.link.calls import PendingCalls
from rce.link.exceptions import (
    CallTimeoutError,
    MessageTooLargeError,
    NotConnectedError,
    OverloadedError,
    PeerFaultError,
    PeerLostError,
    ProtocolError,
)
from rce.link.frames import LATCHED, OVERLOADED, Frame, FrameType, encode_sources, parse_sources
from rce.link.handshake import LATCH
from rce.link.queues import Backlog, OutgoingQueue

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce.control import ConnectionSpec
    from rce.link.interface import Buffer
    from rce.link.link import Link
    from rce.link.slot import InterfaceSlot

_log = logging.getLogger(__name__)

_MAX_FAULT = 4096
"""Longest fault text that is sent, in bytes."""


class Channel:
    """An interface's end of a connection.

    It is *established* while both ends are open: this one since its interface has started, the peer's since
    its OPEN came on the link's present carrier.

    Attributes:
        spec: The connection.
        slot: The interface's place.
        established: Whether messages can be sent.
    """

    def __init__(self, spec: ConnectionSpec, slot: InterfaceSlot, link: Link, backlog: Backlog) -> None:
        self.spec = spec
        self.slot = slot
        self.established = False
        self.link = link
        self._limits = link.limits
        self._calls = PendingCalls(link.limits.max_calls)
        self._backlog = backlog
        self._queue = self._new_queue()

    @property
    def waiting_bytes(self) -> int:
        """Payload bytes that wait to be sent."""
        return self._queue.waiting_bytes

    @property
    def is_busy(self) -> bool:
        """Whether a call, of this end or of the peer, has no answer yet, or something waits to be sent."""
        server = self.slot.server
        return bool(self._calls) or bool(self._queue) or (server is not None and server.serves(self))

    def shed(self, size: int) -> None:
        """Drop the oldest messages of a topic, until ``size`` bytes are free; latched ones stay."""
        self._queue.shed(size)

    def withdraw_latched(self, source: int) -> None:
        """Take the unsent latched message of a source back."""
        self._queue.withdraw_latched(source)

    def release_latched(self, source: int) -> None:
        """Have the unsent latched message of a source that ended be dropped like others."""
        self._queue.release_latched(source)

    @property
    def number(self) -> int:
        """The channel's number on its link."""
        return self.spec.id

    # The life of the channel

    def open(self) -> None:
        """Tell the peer that this end is ready, if it is."""
        if self.slot.started and self.link.carrier is not None:
            self.link.carrier.control(Frame(FrameType.OPEN, self.number))
            if self.number in self.link.peer_open:
                self._set_established(True)

    def peer_opened(self) -> None:
        """Take note that the peer's end is ready."""
        if self.slot.started:
            self._set_established(True)

    def peer_closed(self) -> None:
        """Take note that the peer's end is gone; it may come again."""
        self._set_established(False)

    def close(self) -> None:
        """Tell the peer that this end is gone."""
        if self.slot.started and self.link.carrier is not None:
            self.link.carrier.control(Frame(FrameType.CLOSE, self.number))
        self._set_established(False)

    def _set_established(self, established: bool) -> None:
        if established == self.established:
            return
        self.established = established
        if not established:
            if self.link.carrier is not None:
                self.link.carrier.clear(self._queue)
            self._queue.clear()
            self._queue = self._new_queue()
            self._calls.fail_all(lambda: PeerLostError("the connection was lost"))
        self.slot.channel_changed(self)

    def _new_queue(self) -> OutgoingQueue:
        limits = self._limits
        service = self.slot.role.is_service
        queue_size = self.slot.spec.queue_size or limits.queue_messages
        return OutgoingQueue(
            self.number,
            self.slot.counters,
            OverflowPolicy.REFUSE if service else OverflowPolicy.DROP_OLDEST,
            max_messages=limits.max_calls if service else min(queue_size, limits.queue_messages),
            max_bytes=max(limits.queue_bytes, limits.max_message) if service else limits.queue_bytes,
            backlog=self._backlog,
        )

    # Sending

    def send(self, payload: bytes | memoryview, *, source: int = 0) -> None:
        """Send a message of a topic; the caller has looked at its size.

        Args:
            payload: The message.
            source: Number of the source of a latched message; 0 if it is not latched.
        """
        carrier = self.link.carrier
        if self.established and carrier is not None and not self.link.spec.copy:
            flags = LATCHED if source else 0
            carrier.send(self._queue, Frame(FrameType.DATA, self.number, source, flags, payload))

    def send_sources(self, sources: Collection[int]) -> None:
        """Tell the peer which sources' latched messages are in force, after everything sent before."""
        carrier = self.link.carrier
        if carrier is None or self.link.spec.copy:
            return
        if self.established and LATCH in carrier.features:
            carrier.send(self._queue, encode_sources(self.number, sources))

    async def call(self, payload: bytes | memoryview, deadline: float) -> bytes:
        """Send a request and wait ``deadline`` seconds for its answer. Raises as :meth:`Port.call`."""
        carrier = self.link.carrier
        if not self.established or carrier is None or self.link.spec.copy:
            raise NotConnectedError
        call_id, answer = self._calls.add()
        queue = self._queue
        try:
            carrier.send(queue, Frame(FrameType.CALL, self.number, call_id, 0, payload))
        except OverloadedError:
            self._calls.drop(call_id)
            raise
        try:
            async with asyncio.timeout(deadline):
                return await answer
        except TimeoutError as error:
            raise CallTimeoutError(f"no answer in {deadline:g} s") from error
        finally:
            if self._calls.drop(call_id) and not carrier.withdraw(queue, call_id):
                carrier.control(Frame(FrameType.CANCEL, self.number, call_id))
            del answer  # its error refers to this frame, and so to the request, until the collector comes

    def reply(self, call_id: int, answer: Buffer) -> None:
        """Send the answer to a request."""
        carrier = self.link.carrier
        if not self.established or carrier is None:
            return
        try:
            payload = as_payload(answer, self._limits.max_message)
            carrier.send(self._queue, Frame(FrameType.REPLY, self.number, call_id, 0, payload))
        except (TypeError, MessageTooLargeError, OverloadedError) as error:
            self.fault(call_id, error)

    def fault(self, call_id: int, error: BaseException) -> None:
        """Answer a request with a fault."""
        carrier = self.link.carrier
        if carrier is not None:
            text = (str(error) or type(error).__name__).encode(errors="replace")[:_MAX_FAULT]
            flags = OVERLOADED if isinstance(error, OverloadedError) else 0
            carrier.control(Frame(FrameType.FAULT, self.number, call_id, flags, text))

    # Receiving

    def frame_received(self, frame: Frame) -> None:
        """Take a message of the peer.

        Raises:
            ProtocolError: The peer must not send this.
        """
        if not self.established or self.link.is_standby:
            return  # it was sent before the peer heard that this end closed, or the peer is still a copy
        payload = bytes(frame.payload)
        match frame.type:
            case FrameType.DATA:
                self.slot.receive(self, payload, frame.id if frame.flags & LATCHED else None)
            case FrameType.SOURCES:
                self.slot.keep_sources(self, parse_sources(payload))
            case FrameType.CALL:
                self._request_received(frame.id, payload)
            case FrameType.REPLY:
                self.slot.counters.count_in(len(payload))
                self._calls.answer(frame.id, payload)
            case FrameType.FAULT:
                text = payload.decode(errors="replace")
                overloaded = frame.flags & OVERLOADED
                self._calls.fail(frame.id, OverloadedError(text) if overloaded else PeerFaultError(text))
            case FrameType.CANCEL:
                if self.slot.server is not None:
                    self.slot.server.cancel(self, frame.id)
            case (
                FrameType.HELLO
                | FrameType.WELCOME
                | FrameType.REFUSE
                | FrameType.PING
                | FrameType.PONG
                | FrameType.SECURE
                | FrameType.GRANT
                | FrameType.OPEN
                | FrameType.CLOSE
                | FrameType.TAKE
                | FrameType.LEAVE
                | FrameType.FRAGMENT
                | FrameType.ABORT
            ):
                raise ProtocolError(f"{frame.type.name} on a channel")
            case _:
                assert_never(frame.type)

    def frame_dropped(self, frame: Frame) -> None:
        """Take note that a message of the peer was dropped while it came in, because memory is short.

        Args:
            frame: Its first frame, without payload.
        """
        match frame.type:
            case FrameType.DATA:
                self.slot.message_dropped(self, frame.id if frame.flags & LATCHED else None)
            case FrameType.CALL:
                self.fault(frame.id, OverloadedError("the request was dropped: memory is short"))
            case FrameType.REPLY:
                self._calls.fail(frame.id, OverloadedError("the answer was dropped: memory is short"))
            case _:
                raise AssertionError(f"{frame.type.name} never comes in parts")

    def _request_received(self, call_id: int, payload: bytes) -> None:
        server = self.slot.server
        if server is None:
            self.fault(call_id, TypeError(f"{self.spec.interface} serves no requests"))
            return
        if server.has(self, call_id):
            raise ProtocolError(f"request {call_id} came twice")
        self.slot.counters.count_in(len(payload))
        try:
            server.accept(self, call_id, payload)
        except (OverloadedError, NotConnectedError) as error:
            self.fault(call_id, error)


def as_payload(buffer: Buffer, limit: int) -> bytes | memoryview:
    """Return a payload as the frames need it: its length in bytes, and small enough.

    Raises:
        MessageTooLargeError: It is larger than ``limit`` bytes.
        TypeError: It is not a buffer.
    """
    payload = buffer if isinstance(buffer, bytes) else memoryview(buffer).cast("B")
    if len(payload) > limit:
        raise MessageTooLargeError(len(payload), limit)
    return payload
