"""Publishing: the topics that a node offers, and the handles that a program publishes with."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any

from rce.aio.queues import BoundedQueue
from rce.ros.errors import HandshakeRefusedError, NodeClosedError, TypeMismatchError
from rce.ros.node.local import LocalLink, LocalMessage
from rce.ros.node.registrations import Registration
from rce.ros.node.runtime import Runtime
from rce.ros.node.settings import MAX_QUEUED_BYTES
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import Chunks, frame, payload_of
from rce.ros.tcpros.header import ANY, check_type, encode_header, require

if TYPE_CHECKING:
    from rce.ros.types import Message, MessageType

_log = logging.getLogger(__name__)

Payload = bytes | bytearray | memoryview
"""A serialized message. Large ones are not copied: they must not be changed after they were published."""


class Link:
    """One subscriber of a topic, at the end of a TCPROS connection."""

    transport = "TCPROS"

    def __init__(self, output: TopicOutput, connection: Connection, subscriber: str) -> None:
        self.subscriber = subscriber
        self.connection = connection
        self.messages = 0
        self.bytes_out = 0
        self._output = output
        self._queue: BoundedQueue[Chunks] = BoundedQueue(output.queue_size, MAX_QUEUED_BYTES)

    @property
    def dropped(self) -> int:
        """How many messages were dropped because the subscriber was too slow."""
        return self._queue.dropped

    @property
    def description(self) -> str:
        """The connection's description in the slave API."""
        return str(self.connection)

    def send(self, chunks: Chunks, size: int) -> None:
        """Send a frame, or queue it while the connection is full."""
        if self.connection.full:
            self._queue.put(chunks, size)
            return
        self.messages += 1
        self.bytes_out += size
        self.connection.write(chunks)

    def connection_made(self, connection: Connection) -> None:
        """Do nothing: a link begins when the header came."""

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        """Ignore a frame: subscribers send none."""

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        """Forget the subscriber."""
        del connection, error  # the subscriber reconnects by itself
        self._output.drop(self)

    def writable(self, connection: Connection) -> None:
        """Send waiting frames."""
        while self._queue and not connection.full:
            chunks = self._queue.take()
            self.send(chunks, sum(map(len, chunks)))


class TopicOutput:
    """A topic that the node publishes, shared by all its :class:`Publisher` handles."""

    def __init__(
        self, runtime: Runtime, topic: str, message_type: str | MessageType, queue_size: int
    ) -> None:
        self.topic = topic
        self.message_type_name = message_type if isinstance(message_type, str) else message_type.name
        self.queue_size = queue_size
        self.links: list[Link] = []
        """Subscribers at the other end of a connection."""
        self.local_links: list[LocalLink] = []
        """Subscribers in this process."""
        self.publishers: list[Publisher] = []
        self.registration: Registration
        self.lost = 0
        """Messages dropped on links that are gone."""
        self.is_closed = False
        """Whether it takes no subscribers any more."""
        self.changed = asyncio.Event()
        self.node_name = runtime.name
        self._runtime = runtime
        self._message_type = message_type

    @property
    def message_type(self) -> MessageType:
        """The topic's type."""
        if isinstance(self._message_type, str):
            self._message_type = self._runtime.types.message(self._message_type)
        return self._message_type

    @property
    def known_kind(self) -> MessageType | None:
        """The topic's type if it was needed already."""
        return None if isinstance(self._message_type, str) else self._message_type

    def accept(self, connection: Connection, fields: Mapping[str, str]) -> None:
        """Take a subscriber.

        Raises:
            HandshakeRefusedError: It expects another type.
        """
        require(fields, "md5sum")
        message_type = self.message_type
        check_type(
            fields, md5sum=message_type.md5sum, type_name=message_type.name, subject=f"topic {self.topic}"
        )
        latched = self._latched()
        reply = {
            "callerid": self._runtime.name,
            "topic": self.topic,
            "type": message_type.name,
            "md5sum": message_type.md5sum,
            "message_definition": message_type.definition,
            "latching": "1" if self.is_latching else "0",
        }
        link = Link(self, connection, fields.get("callerid", ANY))
        connection.owner = link
        connection.write((encode_header(reply),))
        for chunks in latched:
            link.send(chunks, sum(map(len, chunks)))
        self.links.append(link)
        self._joined()

    def attach(self, link: LocalLink, md5sum: str) -> None:
        """Take a subscriber of this process.

        Raises:
            HandshakeRefusedError: It expects another type.
        """
        if md5sum not in (ANY, self.message_type.md5sum):
            raise HandshakeRefusedError(
                f"{self.topic} is of type {self.message_type.name} there, "
                f"which does not have md5 sum {md5sum}"
            )
        link.md5sum = self.message_type.md5sum
        for chunks in self._latched():
            link.send(LocalMessage(self.message_type, payload=payload_of(chunks)), latched=True)
        self.local_links.append(link)
        self._joined()

    def send_locally(self, local_message: LocalMessage) -> None:
        """Give a message to the subscribers of this process."""
        latched = self.is_latching
        for link in self.local_links:
            link.send(local_message, latched=latched)

    def drop(self, link: Link | LocalLink) -> None:
        """Forget a subscriber that is gone."""
        self.lost += link.dropped
        if isinstance(link, LocalLink):
            self.local_links.remove(link)
        else:
            self.links.remove(link)
        self.changed.set()

    def close(self) -> None:
        """Close all links."""
        self.is_closed = True
        for link in self.links:
            link.connection.close()
        for local in self.local_links:
            local.end()

    async def until_linked(self, count: int) -> None:
        """Wait until there are at least ``count`` subscribers.

        Raises:
            NodeClosedError: The node was told to stop.
        """
        while len(self.all_links) < count:
            self._runtime.check_running()
            self.changed.clear()
            await self.changed.wait()

    @property
    def all_links(self) -> list[Link | LocalLink]:
        """The subscribers of either sort."""
        return [*self.links, *self.local_links]

    @property
    def is_latching(self) -> bool:
        """Whether a new subscriber may get an old message."""
        return any(publisher.latch or publisher.latched for publisher in self.publishers)

    def _latched(self) -> list[Chunks]:
        return [chunks for publisher in self.publishers for chunks in publisher.latched.values()]

    def _joined(self) -> None:
        self.changed.set()
        for publisher in self.publishers:
            if publisher.on_subscriber is not None:
                try:
                    publisher.on_subscriber()
                except Exception:  # noqa: BLE001 - the program's own fault: the subscriber is connected
                    _log.exception("the on_subscriber callback of %s failed", self.topic)


class Publisher:
    """Publishes on one topic. Made by :meth:`rce.ros.node.Node.advertise`.

    Publishing never waits: a subscriber that is too slow loses its own oldest messages and delays no other.

    Attributes:
        latch: Whether the last message is given to later subscribers.
        latched: The frames that later subscribers get, by the source that they are of.
        on_subscriber: Called whenever another subscriber is connected; to be set by the program. What it
            raises is logged.
    """

    def __init__(
        self, output: TopicOutput, *, latch: bool, release: Callable[[Publisher], Awaitable[None]]
    ) -> None:
        self.latch = latch
        self.latched: dict[str, Chunks] = {}
        self.on_subscriber: Callable[[], None] | None = None
        self._output = output
        self._release = release
        self._closed = False

    @property
    def topic(self) -> str:
        """The topic's global name."""
        return self._output.topic

    @property
    def type(self) -> MessageType:
        """The topic's type."""
        return self._output.message_type

    @property
    def connections(self) -> int:
        """How many subscribers are connected to the topic."""
        return len(self._output.all_links)

    @property
    def dropped(self) -> int:
        """How many messages were dropped for slow subscribers, counted once for each subscriber."""
        return self._output.lost + sum(link.dropped for link in self._output.all_links)

    def publish(self, message: Message | Mapping[str, Any] | None = None, /, **fields: Any) -> None:
        """Publish a message, given as an object, as a mapping of its fields, or by its fields.

        Subscribers in this process may be given the object itself: it must not be changed afterwards.

        Raises:
            SerializationError: A value does not fit its field.
            TypeMismatchError: The message is of another type.
            NodeClosedError: The publisher was closed.
        """
        message_type = self._output.message_type
        if message is None:
            message = message_type.new(**fields)
        elif fields:
            raise TypeError("give a message or its fields, not both")
        elif message.__class__ is not message_type.cls and not isinstance(message, Mapping):
            raise TypeMismatchError(f"{self.topic} carries {message_type.name}, not {type(message).__name__}")
        if self._output.local_links and not isinstance(message, Mapping):
            self._publish_locally(message_type, message)
            return
        self.publish_serialized(message_type.serialize(message))

    def publish_serialized(self, payload: Payload, latch: bool = False, source: str = "") -> None:
        """Publish a serialized message, untouched.

        Args:
            payload: The message's bytes.
            latch: Remember this message for later subscribers, whatever :attr:`latch` says.
            source: The original publisher, if this publishes for others: one message of each is remembered.

        Raises:
            NodeClosedError: The publisher was closed.
        """
        output = self._output
        self._send(payload, latch, source)
        if output.local_links:
            output.send_locally(LocalMessage(output.known_kind, payload=bytes(payload)))

    def unlatch(self, source: str = "") -> None:
        """Forget the message that is remembered of a source; no later subscriber gets it."""
        self.latched.pop(source, None)

    def _send(self, payload: Payload, latch: bool, source: str = "") -> None:
        """Send to the subscribers of other processes."""
        if self._closed:
            raise NodeClosedError(f"the publisher of {self.topic} is closed")
        chunks = frame(payload)
        if latch or self.latch:
            self.latched[source] = chunks
        size = len(payload)
        for link in self._output.links:
            link.send(chunks, size)

    def _publish_locally(self, message_type: MessageType, message: Message) -> None:
        """Give an object to the subscribers of this process; write it only if there are others."""
        output = self._output
        if self._closed:
            raise NodeClosedError(f"the publisher of {self.topic} is closed")
        local_message = LocalMessage(message_type, message)
        if output.links or self.latch:
            self._send(local_message.payload(), False)
        output.send_locally(local_message)

    async def wait_for_subscribers(self, count: int = 1, *, timeout: float | None = None) -> None:
        """Wait until at least ``count`` subscribers are connected.

        Raises:
            TimeoutError: They did not come within ``timeout`` seconds.
            NodeClosedError: The node was told to stop.
        """
        async with asyncio.timeout(timeout):
            await self._output.until_linked(count)

    async def close(self) -> None:
        """Stop publishing; the last publisher of a topic unregisters it and disconnects its subscribers."""
        if not self._closed:
            self._closed = True
            await self._release(self)
