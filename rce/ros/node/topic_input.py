"""Subscribing, the network's side: a connection to each publisher of a topic, made again when it is lost.

As in rospy, a connection ends when the publisher ends it, not when the master ceases to name the publisher.
A master that was restarted knows no nodes, and a synchronization takes back the nodes of a master or
discovery that was killed, while they publish as before.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from rce.aio.backoff import Backoff
from rce.ros.dialing import open_peer_socket
from rce.ros.errors import HandshakeRefusedError, RosError, TcprosError, TypeMismatchError
from rce.ros.node.input_link import HeaderReader, InputLink, says_latching
from rce.ros.node.local import LocalLink, LocalMessage, find_neighbour
from rce.ros.node.registrations import Registration
from rce.ros.node.runtime import Runtime
from rce.ros.node.subscriber import Subscriber
from rce.ros.tcpros.address import ask_address
from rce.ros.tcpros.connection import Connection, Owner
from rce.ros.tcpros.header import ANY, encode_header

if TYPE_CHECKING:
    from rce.ros.node.topics import Topics

_log = logging.getLogger(__name__)

CONNECT_TIMEOUT = 10.0
LATCH_TIMEOUT = 2.0
"""Seconds that a publisher has to say again whether it latches; without an answer it does not."""
ASKING = "_asks"
"""Appended to the node's name where a publisher is asked only for its header."""
RETRY = Backoff(first=0.05, longest=5.0, jitter=0.5)
"""Seconds between attempts to reach a publisher: the first wait and the longest."""
MAX_REGISTRATIONS = 3
"""How often the master is asked for the publishers while it reports changes of them meanwhile."""
HANGING = 10.0
"""Seconds for which nothing came from an orphan until, named again, it is connected to anew: the network may
have been away."""


class _Orphan(NamedTuple):
    """A publisher that the master does not name any more, but whose connection is there."""

    since: float
    """When the master ceased to name it; the event loop's time, seconds."""
    messages: int
    """How many had come by then."""


class TopicInput:
    """A topic that the node subscribes to, shared by all its :class:`Subscriber` handles."""

    def __init__(self, runtime: Runtime, topic: str, message_type_name: str, md5sum: str) -> None:
        self.topic = topic
        self.message_type_name = message_type_name
        self.md5sum = md5sum
        self.subscribers: list[Subscriber] = []
        self.registration: Registration
        self.links: list[InputLink | LocalLink] = []
        self.changed = asyncio.Event()
        self._runtime = runtime
        self._own_uri = runtime.master.slave_uri
        self._publishers: set[str] = set()
        """The slave APIs of all publishers, as the master named them last."""
        self._following: dict[str, asyncio.Task[None]] = {}
        self._orphans: dict[str, _Orphan] = {}
        """By slave API; followed until their connection ends, or the master names them again."""
        self._updates = 0
        """How many changes of the publishers the master has reported."""

    @property
    def tells_latched(self) -> bool:
        """Whether a subscriber has to know which messages are latched."""
        return any(not subscriber.decodes for subscriber in self.subscribers)

    def check(self, message_type_name: str, md5sum: str) -> None:
        """Check that another subscriber of the node expects the same type; the first concrete one counts.

        Publishers of another type end, which were taken while any type was expected.

        Raises:
            TypeMismatchError: It does not.
        """
        if md5sum in (ANY, self.md5sum):
            return
        if self.md5sum != ANY:
            raise TypeMismatchError(
                f"{self.topic} is subscribed to as {self.message_type_name} already, not {message_type_name}"
            )
        self.message_type_name, self.md5sum = message_type_name, md5sum
        for link in self.links:
            if link.md5sum not in (ANY, md5sum):
                link.refuse(
                    HandshakeRefusedError(
                        f"topic {self.topic} is of type {message_type_name} with md5 sum {md5sum} here,"
                        f" of a type with md5 sum {link.md5sum} there"
                    )
                )

    def connected(self) -> int:
        """Return how many publishers have accepted the subscription."""
        return sum(link.is_greeted and not link.ended.done() for link in self.links)

    def deliver(self, payload: bytes, latched: bool, uri: str) -> None:
        """Give a message of a publisher's to all subscribers."""
        own = uri == self._own_uri
        for subscriber in self.subscribers:
            if subscriber.hears_own or not own:
                subscriber.sink.deliver(payload, latched, uri)

    def deliver_local(self, local_message: LocalMessage, latched: bool, uri: str) -> None:
        """Give a message of a publisher of this process to all subscribers."""
        own = uri == self._own_uri
        for subscriber in self.subscribers:
            if subscriber.hears_own or not own:
                self._hand_over(subscriber, local_message, latched, uri)

    def _hand_over(
        self, subscriber: Subscriber, local_message: LocalMessage, latched: bool, uri: str
    ) -> None:
        item: LocalMessage | bytes = local_message
        if not subscriber.decodes:
            try:
                item = local_message.payload()
            except ValueError as error:  # a SerializationError; the types may not be imported yet
                _log.warning("a message of %s cannot be written: %s", self.topic, error)
                return
        subscriber.sink.deliver(item, latched, uri)

    def lose(self, uri: str) -> None:
        """Tell all subscribers that the connection to a publisher ended."""
        for subscriber in self.subscribers:
            subscriber.sink.lose(uri)

    def catch_up(self, subscriber: Subscriber) -> None:
        """Give a subscriber that came later the latched messages; they come only once over a connection."""
        self._follow_publishers()
        for link in self.links:
            if link.uri == self._own_uri and not subscriber.hears_own:
                continue
            if isinstance(link.kept, LocalMessage):
                self._hand_over(subscriber, link.kept, True, link.uri)
            elif link.kept is not None:
                subscriber.sink.deliver(link.kept, True, link.uri)

    async def register(self) -> None:
        """Register the subscription at the master, and follow the publishers that it names.

        An answer is older or newer than a change that the master reports before it comes. If they differ,
        the master is asked again.

        Raises:
            MasterError: The registration at the master failed.
        """
        for _ in range(MAX_REGISTRATIONS):
            before = self._updates
            publishers = await self._runtime.master.register_subscriber(self.topic, self.message_type_name)
            if not self.subscribers:  # closed meanwhile
                return
            if self._updates == before:
                self.set_publishers(publishers)
                return
            if set(publishers) == self._publishers:
                return

    def take_update(self, uris: Iterable[str]) -> None:
        """Follow the publishers that the master reports after a change."""
        self._updates += 1
        self.set_publishers(uris)

    def set_publishers(self, uris: Iterable[str]) -> None:
        """Follow these publishers, given by their slave APIs, and others while their connections last."""
        self._publishers = set(uris)
        self._follow_publishers()

    def _follow_publishers(self) -> None:
        wanted = set(self._publishers)
        if not any(subscriber.hears_own for subscriber in self.subscribers):
            wanted.discard(self._own_uri)
        now = asyncio.get_running_loop().time()
        links = {link.uri: link for link in self.links if link.is_greeted}
        for uri in self._orphans.keys() & wanted:
            since, messages = self._orphans.pop(uri)
            if uri in links and links[uri].messages == messages and now - since >= HANGING:
                self._following.pop(uri).cancel()
        for uri in self._following.keys() - wanted - self._orphans.keys():
            if uri in links and uri not in self._publishers:
                self._orphans[uri] = _Orphan(now, links[uri].messages)
            else:
                self._following.pop(uri).cancel()
        for uri in wanted - self._following.keys():
            self._following[uri] = self._runtime.tasks.spawn(
                self._follow(uri), name=f"{self.topic} from {uri}"
            )

    def close(self) -> None:
        """Follow no publishers any more."""
        self._publishers.clear()
        self._orphans.clear()
        while self._following:
            self._following.popitem()[1].cancel()

    async def _follow(self, uri: str) -> None:
        """Receive from one publisher; connect again for as long as the master names it."""
        pauses = RETRY.start()
        while True:
            link = InputLink(self, uri)
            neighbour = find_neighbour(uri) if self._runtime.intra_process else None
            try:
                await (self._receive(link) if neighbour is None else self._receive_locally(uri, neighbour))
            except HandshakeRefusedError as error:
                _log.warning("no messages of %s from %s: %s", self.topic, uri, error)
            except (RosError, OSError) as error:
                _log.info("%s from %s: %s", self.topic, uri, str(error) or type(error).__name__)
            if uri in self._orphans:
                del self._orphans[uri]
                del self._following[uri]
                return
            if link.messages:
                pauses.reset()
            await asyncio.sleep(pauses.next())

    async def _receive_locally(self, uri: str, neighbour: Topics) -> None:
        output = neighbour.outputs.get(self.topic)
        if output is None or output.is_closed:
            raise TcprosError(f"{uri} does not offer {self.topic}")
        link = LocalLink(
            self,
            uri=uri,
            publisher=output.node_name,
            subscriber=self._runtime.name,
            queue_size=output.queue_size,
        )
        output.attach(link, self.md5sum)
        self.links.append(link)
        self.changed.set()
        try:
            await link.ended
        finally:
            self.links.remove(link)
            self.lose(link.uri)
            output.drop(link)

    async def _receive(self, link: InputLink) -> None:
        connection = await self._connect(link, link.uri)
        self.links.append(link)
        try:
            connection.write((encode_header(self._header()),))
            if await link.in_doubt:
                latched = False
                try:
                    latched = await self._latches(link.uri)
                finally:
                    link.settle(connection, latched=latched)
            await link.ended
        finally:
            self.links.remove(link)
            self.lose(link.uri)
            connection.abort()
            await connection.gone.wait()

    async def _connect(self, owner: Owner, uri: str) -> Connection:
        host, port = await ask_address(self._runtime.rpc, uri, self.topic, self._runtime.name)
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(CONNECT_TIMEOUT):
            _, connection = await loop.create_connection(
                lambda: Connection(owner, self._runtime.scratch), sock=await open_peer_socket(host, port)
            )
        return connection

    async def _latches(self, uri: str) -> bool:
        """Ask a publisher that has published whether it latches, over a connection made for that.

        A rospy publisher is registered a moment before it is told to latch, and says that it does not latch
        to those who subscribe in between (``rospy.Publisher.__init__``). It keeps one connection of a name,
        so this one has another name.
        """
        reader = HeaderReader()
        try:
            async with asyncio.timeout(LATCH_TIMEOUT):
                connection = await self._connect(reader, uri)
                try:
                    header = self._header() | {"callerid": f"{self._runtime.name}{ASKING}"}
                    connection.write((encode_header(header),))
                    return says_latching(await reader.fields)
                finally:
                    connection.abort()
                    await connection.gone.wait()
        except (RosError, OSError, TimeoutError) as error:
            _log.debug("%s from %s: not known whether it latches: %r", self.topic, uri, error)
            return False

    def _header(self) -> dict[str, str]:
        return {
            "callerid": self._runtime.name,
            "topic": self.topic,
            "type": self.message_type_name,
            "md5sum": self.md5sum,
            "tcp_nodelay": "1",
        }
