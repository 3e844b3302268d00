"""Carriers of a link's frames: a socket, or a pair of objects in one process."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from typing import TYPE_CHECKING, Protocol

from rce.link.exceptions import LinkLostError, ProtocolError
from rce.link.handshake import FEATURES

if TYPE_CHECKING:
    from rce.link.frames import Frame
    from rce.link.pacing import Pacer
    from rce.link.queues import OutgoingQueue


_TURN = 1 << 20
"""Bytes after which the delivery within a process lets the event loop do something else."""


class CarrierHandler(Protocol):
    """Receives the frames and the end of a carrier."""

    def frame_received(self, frame: Frame) -> None:
        """Take a frame of the peer.

        Raises:
            ProtocolError: The peer must not send this; the carrier ends.
        """
        ...

    def grew(self) -> None:
        """Notice that the carrier's :attr:`Carrier.unfinished_bytes` grew."""
        ...

    def carrier_lost(self, carrier: Carrier, reason: Exception) -> None:
        """Notice that the carrier ended. Called once, and nothing comes after it."""
        ...


class Carrier(ABC):
    """A live connection between the two ends of a link.

    Attributes:
        features: What the peer knows beyond the first version of links.
    """

    features: frozenset[str] = frozenset()

    @property
    @abstractmethod
    def kind(self) -> str:
        """``unix``, ``tcp`` or ``local``."""

    @abstractmethod
    def start(self, handler: CarrierHandler) -> None:
        """Begin to hand frames over. Nothing is handed over before, and nothing is lost."""

    @abstractmethod
    def pace(self, pacer: Pacer | None) -> None:
        """Limit what passes; none for no limit. A link within a process is not traffic and has no limit."""

    @property
    @abstractmethod
    def traffic(self) -> tuple[int, int]:
        """Bytes that came in and that went out, with headers."""

    @property
    @abstractmethod
    def unfinished_bytes(self) -> int:
        """Bytes that are set aside for messages that have not come as a whole yet."""

    @abstractmethod
    def drop_unfinished(self, size: int) -> list[Frame]:
        """Forget the oldest of those messages until ``size`` bytes are free; return their first frames."""

    @abstractmethod
    def control(self, frame: Frame) -> None:
        """Send a small frame of the link itself, before all messages. Ignored when the carrier ended."""

    @abstractmethod
    def send(self, queue: OutgoingQueue, frame: Frame) -> None:
        """Send a message of a channel, after those that wait in its queue. Ignored when the carrier ended.

        Raises:
            OverloadedError: The queue is full and its policy is to refuse.
        """

    @abstractmethod
    def withdraw(self, queue: OutgoingQueue, call_id: int) -> bool:
        """Take a call back of which a part at least has not been sent; false if it is on its way."""

    @abstractmethod
    def clear(self, queue: OutgoingQueue) -> None:
        """Throw away what waits on a channel."""

    @abstractmethod
    def abort(self, reason: Exception) -> None:
        """End the carrier at once; its handler is told the reason in a later step of the event loop."""

    @abstractmethod
    def close(self) -> None:
        """End the carrier, without :meth:`CarrierHandler.carrier_lost` at this end."""

    @abstractmethod
    async def wait_closed(self) -> None:
        """Wait until the carrier has ended and has released everything."""


class LocalCarrier(Carrier):
    """One half of a link between two endpoints of one process.

    Payloads are handed over as they are. Delivery is a later step of the event loop, so that interfaces which
    answer at once cannot recurse. A step delivers the messages that were there when it began, up to 1 MB or
    one larger message, so that two halves cannot block the loop.
    """

    kind = "local"
    features = frozenset(FEATURES)

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._peer: LocalCarrier | None = None
        self._handler: CarrierHandler | None = None
        self._inbox: deque[Frame] = deque()
        self._delivery: asyncio.Handle | None = None
        self._closed = self._loop.create_future()

    @classmethod
    def pair(cls) -> tuple[LocalCarrier, LocalCarrier]:
        """Make both halves."""
        one, other = cls(), cls()
        one._peer, other._peer = other, one
        return one, other

    def start(self, handler: CarrierHandler) -> None:
        """Begin to hand frames over."""
        self._handler = handler
        self._schedule()

    def pace(self, pacer: Pacer | None) -> None:
        """Do nothing: this is not traffic."""

    @property
    def traffic(self) -> tuple[int, int]:
        """Nothing."""
        return 0, 0

    @property
    def unfinished_bytes(self) -> int:
        """Nothing: messages come as a whole."""
        return 0

    def drop_unfinished(self, size: int) -> list[Frame]:  # noqa: ARG002 - messages come as a whole
        """Return nothing."""
        return []

    def abort(self, reason: Exception) -> None:
        """End both halves."""
        self.close()
        if self._handler is not None:
            self._loop.call_soon(self._handler.carrier_lost, self, reason)

    def control(self, frame: Frame) -> None:
        """Send a frame."""
        if self._peer is not None:
            self._peer._take(frame)  # noqa: SLF001 - same module

    def send(self, queue: OutgoingQueue, frame: Frame) -> None:
        """Send a message; nothing ever waits here."""
        queue.counters.count_frame(frame)
        if type(frame.payload) is not bytes:
            frame = frame._replace(payload=bytes(frame.payload))
        self.control(frame)

    def withdraw(self, queue: OutgoingQueue, call_id: int) -> bool:  # noqa: ARG002 - nothing waits here
        """Return false: the call is on its way."""
        return False

    def clear(self, queue: OutgoingQueue) -> None:
        """Do nothing: nothing waits here."""

    def close(self) -> None:
        """End both halves; the peer's handler learns it in a later step of the event loop."""
        peer = self._end()
        if peer is not None:
            self._loop.call_soon(peer._lose)  # noqa: SLF001 - same module

    async def wait_closed(self) -> None:
        """Wait until this half has ended."""
        await asyncio.shield(self._closed)

    def _end(self) -> LocalCarrier | None:
        peer, self._peer = self._peer, None
        self._inbox.clear()
        if self._delivery is not None:
            self._delivery.cancel()
        if not self._closed.done():
            self._closed.set_result(None)
        return peer

    def _lose(self) -> None:
        if self._end() is not None and self._handler is not None:
            self._handler.carrier_lost(self, LinkLostError("the peer ended the link"))

    def _take(self, frame: Frame) -> None:
        if not self._closed.done():
            self._inbox.append(frame)
            self._schedule()

    def _schedule(self) -> None:
        if self._delivery is None and self._inbox and self._handler is not None:
            self._delivery = self._loop.call_soon(self._deliver)

    def _deliver(self) -> None:
        self._delivery = None
        assert self._handler is not None
        budget = _TURN
        for _ in range(len(self._inbox)):
            if not self._inbox:
                return
            if budget <= 0:
                break
            frame = self._inbox.popleft()
            budget -= len(frame.payload)
            try:
                self._handler.frame_received(frame)
            except ProtocolError as error:
                self.close()
                self._handler.carrier_lost(self, error)
                return
        self._schedule()
