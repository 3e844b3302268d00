"""Messages between nodes of one process: handed over as objects, without serialization.

Every subscriber of the process gets the published object itself. Neither side may change it afterwards; to
publish another message, make a new object. Otherwise delivery works as over a connection: in order, not
within the call that publishes, and the oldest messages are dropped if too many wait.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from rce.aio.queues import BoundedQueue
from rce.ros.node.settings import MAX_QUEUED_BYTES
from rce.ros.tcpros.header import ANY

if TYPE_CHECKING:
    from rce.ros.errors import HandshakeRefusedError
    from rce.ros.node.topics import Topics
    from rce.ros.types import Message, MessageType

TRANSPORT = "INTRAPROCESS"
"""Name of this transport in the slave API; roscpp's word."""

_neighbours: dict[str, tuple[asyncio.AbstractEventLoop, Topics]] = {}
"""Topics of all nodes of this process that deliver locally, by their slave APIs."""


@contextmanager
def neighbour(uri: str, topics: Topics) -> Iterator[None]:
    """Register a node's topics for local delivery to the other nodes of this event loop."""
    _neighbours[uri] = (asyncio.get_running_loop(), topics)
    try:
        yield
    finally:
        del _neighbours[uri]


def find_neighbour(uri: str) -> Topics | None:
    """Return the topics of the node whose slave API is ``uri`` if it runs in this event loop."""
    loop, topics = _neighbours.get(uri, (None, None))
    return topics if loop is asyncio.get_running_loop() else None


class LocalMessage:
    """A published message, as an object, as bytes, or both; each is made from the other when needed."""

    __slots__ = ("_message", "_message_type", "_payload", "_size")

    def __init__(
        self, message_type: MessageType | None, message: Message | None = None, payload: bytes | None = None
    ) -> None:
        assert payload is not None or (message_type is not None and message is not None)
        self._message_type = message_type
        self._message = message
        self._payload = payload
        self._size = -1 if payload is None else len(payload)

    def __len__(self) -> int:
        """Bytes that the message has on the wire; text counts as a byte a character until it is written."""
        if self._size < 0:
            assert self._message_type is not None
            assert self._message is not None
            self._size = self._message_type.size(self._message)
        return self._size

    def payload(self) -> bytes:
        """Return the serialized message."""
        if self._payload is None:
            assert self._message_type is not None
            assert self._message is not None
            self._payload = bytes(self._message_type.serialize(self._message))
            self._size = len(self._payload)
        return self._payload

    def message(self, message_type: MessageType) -> Message:
        """Return the message as an object of a type with the same checksum."""
        if self._message is None or self._message.__class__ is not message_type.cls:
            return message_type.deserialize(self.payload())
        return self._message


class LocalListener(Protocol):
    """Receives the messages of a local link."""

    def deliver_local(self, local_message: LocalMessage, latched: bool, uri: str) -> None:
        """Take a message of the node with this slave API; must neither wait nor raise."""


class LocalLink:
    """A publisher's and a subscriber's topic of one process, seen from both sides.

    Attributes:
        uri: The publisher's slave API.
        publisher: The publishing node's name.
        subscriber: The subscribing node's name.
        messages: How many messages were delivered.
        bytes_in: Bytes that these would have on the wire.
        bytes_out: The same.
        md5sum: Checksum of the published type.
        kept: The newest message of a latching publisher.
        ended: Done when the publisher's topic is closed; failed if the subscriber refused its type.
    """

    is_greeted = True
    transport = TRANSPORT

    def __init__(
        self, listener: LocalListener, *, uri: str, publisher: str, subscriber: str, queue_size: int
    ) -> None:
        self.uri = uri
        self.publisher = publisher
        self.subscriber = subscriber
        self.messages = 0
        self.bytes_in = 0
        self.md5sum = ANY
        self.kept: LocalMessage | None = None
        loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[None] = loop.create_future()
        self._loop = loop
        self._listener = listener
        self._queue: BoundedQueue[tuple[LocalMessage, bool]] = BoundedQueue(queue_size, MAX_QUEUED_BYTES)
        self._is_due = False
        """Whether the event loop will call :meth:`_deliver`."""

    @property
    def bytes_out(self) -> int:
        """Bytes sent: all are received."""
        return self.bytes_in

    @property
    def dropped(self) -> int:
        """How many messages were dropped because too many were published at once."""
        return self._queue.dropped

    @property
    def description(self) -> str:
        """The connection's description in the slave API."""
        return f"{TRANSPORT} {self.publisher} to {self.subscriber}"

    def send(self, local_message: LocalMessage, *, latched: bool) -> None:
        """Queue a message; it is delivered as soon as the event loop is free."""
        if self.ended.done():
            return
        self._queue.put((local_message, latched), len(local_message))
        self._deliver_soon()

    def end(self) -> None:
        """End the link from the publisher's side; waiting messages are still delivered."""
        if not self.ended.done():
            self.ended.set_result(None)

    def refuse(self, error: HandshakeRefusedError) -> None:
        """End the link from the subscriber's side: nothing more is delivered."""
        self._queue.clear()
        self.kept = None
        if not self.ended.done():
            self.ended.set_exception(error)

    def _deliver_soon(self) -> None:
        if self._queue and not self._is_due:
            self._is_due = True
            self._loop.call_soon(self._deliver)

    def _deliver(self) -> None:
        self._is_due = False
        try:
            self._deliver_waiting(len(self._queue))
        finally:
            self._deliver_soon()

    def _deliver_waiting(self, count: int) -> None:
        """Deliver what waits now; what callbacks publish meanwhile comes when others had their turn."""
        for _ in range(count):
            if not self._queue:
                return
            local_message, latched = self._queue.take()
            self.messages += 1
            self.bytes_in += len(local_message)
            if latched:
                self.kept = local_message
            self._listener.deliver_local(local_message, latched, self.uri)
