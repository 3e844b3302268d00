"""The container's ends of connections: ROS topics and services, their messages passed through untouched."""

from __future__ import annotations

import asyncio
import logging
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Collection
from itertools import islice
from typing import TYPE_CHECKING

from rce.aio.backoff import Backoff
from rce.aio.tasks import cancel_and_wait
from rce.link import Buffer, CallError, Interface, InterfaceError, Port
from rce.model import Form, InterfaceSpec, InterfaceType, Role
from rce.ros import names
from rce.ros.errors import MasterUnreachableError, RosError

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher, Service, ServiceClient, Subscriber
    from rce.ros.types import TypeRegistry

READY_TIMEOUT_S = 30.0
"""Maximum time that an interface waits for nodes that start one after the other."""
_LOOK_AGAIN_S = 0.05
"""Seconds between two looks whether nodes still start: one look for all interfaces that wait."""
_RELEASED_AT_ONCE = 100
"""How many interfaces stop waiting before others have their turn; a container may have thousands."""
RETRY = Backoff(first=0.2, longest=5.0, jitter=0.5)
"""Pauses between attempts to register at a core that does not answer."""

_log = logging.getLogger(__name__)


class Readiness:
    """Delays started interfaces until nodes of the container are ready for them.

    Args:
        settling: Whether nodes of the container are starting, or soon will, and may yet register a topic or
            service.
    """

    def __init__(self, settling: Callable[[], bool]) -> None:
        self._settling = settling
        self._waiting: dict[asyncio.Future[None], None] = {}
        self._is_looking = False

    async def wait(self, ready: Awaitable[object]) -> None:
        """Wait for ``ready`` as long as nodes are starting."""
        task = asyncio.ensure_future(ready)
        settled = asyncio.get_running_loop().create_future()
        self._waiting[settled] = None
        if not self._is_looking:
            self._look()
        try:
            await asyncio.wait((task, settled), timeout=READY_TIMEOUT_S, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._waiting.pop(settled, None)
            await cancel_and_wait(task)

    def _look(self) -> None:
        """Release interfaces when no node is starting; look again while some wait."""
        loop = asyncio.get_running_loop()
        is_settling = self._settling()
        if not is_settling:
            for settled in list(islice(self._waiting, _RELEASED_AT_ONCE)):
                del self._waiting[settled]
                settled.set_result(None)
        self._is_looking = bool(self._waiting)
        if self._is_looking:
            loop.call_later(_LOOK_AGAIN_S if is_settling else 0.0, self._look)


class RosInterface(Interface):
    """Base of the four kinds of interfaces."""

    def __init__(self, port: Port, node: Node, readiness: Readiness) -> None:
        super().__init__(port)
        self.node = node
        self.readiness = readiness
        self.addr = names.resolve(port.spec.addr, node.name)
        self.message_type = port.spec.message_type

    async def start(self) -> None:
        """Register the topic or service, and wait until a starting node has registered it too."""
        pauses = RETRY.start()
        while True:
            try:
                await self.open()
            except MasterUnreachableError as error:
                # The core is in this process: it was held, or stopped, for longer than a call may take.
                _log.info("%s is registered again: %s", self.addr, error)
            except RosError as error:
                raise InterfaceError(f"{self.addr}: {error}") from error
            else:
                return
            await asyncio.sleep(pauses.next())

    @abstractmethod
    async def open(self) -> None:
        """Do the work of :meth:`start`; may raise errors of ROS."""


class PublisherInterface(RosInterface):
    """Publishes the peers' messages in the container."""

    publisher: Publisher | None = None

    async def open(self) -> None:
        """Advertise the topic."""
        self.publisher = await self.node.advertise(self.addr, self.message_type)
        await self.readiness.wait(self.publisher.wait_for_subscribers(1))

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Publish one message."""
        if self.publisher is not None:
            self.publisher.publish_serialized(payload, latch=latched)

    def receive_latched(self, payload: bytes, source: str) -> None:
        """Publish one message, and give it to nodes that subscribe later."""
        if self.publisher is not None:
            self.publisher.publish_serialized(payload, latch=True, source=source)

    def unlatch(self, sources: Collection[str]) -> None:
        """Stop giving messages of these sources to nodes that subscribe later."""
        if self.publisher is not None:
            for source in sources:
                self.publisher.unlatch(source)

    async def close(self) -> None:
        """Unadvertise the topic."""
        if self.publisher is not None:
            await self.publisher.close()


class SubscriberInterface(RosInterface):
    """Sends messages of the container's nodes to the peers, but not those of its own interfaces."""

    subscriber: Subscriber | None = None

    def __init__(self, port: Port, node: Node, readiness: Readiness) -> None:
        super().__init__(port, node, readiness)
        self._sources: dict[str, None] = {}
        """Publishers whose last message is latched, oldest first."""

    async def open(self) -> None:
        """Subscribe to the topic."""
        self.subscriber = await self.node.listen(self.addr, self.message_type, self)

    def received(self, payload: bytes) -> None:
        """Send a node's message."""
        self.port.send(payload)

    def received_latched(self, payload: bytes, source: str) -> None:
        """Send a node's message, also to peers that come later."""
        self._sources[source] = None
        self.port.send(payload, latched=True, source=source)

    def source_ended(self, source: str) -> None:
        """Stop giving messages of an ended node to peers that come later."""
        self._sources.pop(source, None)
        self.port.keep_latched(self._sources)

    async def close(self) -> None:
        """Unsubscribe."""
        if self.subscriber is not None:
            await self.subscriber.close()


class ServiceClientInterface(RosInterface):
    """Calls a service in the container for the peers."""

    client: ServiceClient | None = None

    async def open(self) -> None:
        """Look up the service."""
        self.client = self.node.service_client(self.addr, self.message_type)
        await self.readiness.wait(self.node.wait_for_service(self.addr))

    async def serve(self, payload: bytes) -> Buffer:
        """Pass a request on and return the answer; the caller gets the error text of a failing service."""
        assert self.client is not None
        return await self.client.call_serialized(payload)

    async def close(self) -> None:
        """Drop the connections to the service."""
        if self.client is not None:
            await self.client.close()


class ServiceProviderInterface(RosInterface):
    """Offers in the container a service that the peer provides."""

    service: Service | None = None

    async def open(self) -> None:
        """Advertise the service."""
        self.service = await self.node.advertise_service_serialized(self.addr, self.message_type, self._ask)

    async def _ask(self, payload: bytes) -> bytes:
        try:
            return await self.port.call(payload)
        except CallError as error:
            raise RosError(f"{self.addr}: {error}") from error

    async def close(self) -> None:
        """Unadvertise the service."""
        if self.service is not None:
            await self.service.close()


_KINDS: dict[Role, type[RosInterface]] = {
    Role.PUBLISHER: PublisherInterface,
    Role.SUBSCRIBER: SubscriberInterface,
    Role.SERVICE_CLIENT: ServiceClientInterface,
    Role.SERVICE_PROVIDER: ServiceProviderInterface,
}


class InterfaceMaker:
    """Makes a container's interfaces; a :data:`rce.link.InterfaceFactory`.

    Args:
        node: The environment's own node, which registers topics and services.
        types: Knows the messages' and services' types.
        readiness: Decides how long interfaces wait for nodes.
    """

    def __init__(self, node: Node, types: TypeRegistry, readiness: Readiness) -> None:
        self._node = node
        self._types = types
        self._readiness = readiness

    def __call__(self, port: Port) -> Interface:
        """Make the interface for a port.

        Raises:
            InterfaceError: Its spec cannot be fulfilled; the text says what to do.
        """
        spec = port.spec
        try:
            kind = self._check(spec)
        except (ValueError, LookupError, RosError, OSError) as error:
            raise InterfaceError(str(error)) from error
        return kind(port, self._node, self._readiness)

    def _check(self, spec: InterfaceSpec) -> type[RosInterface]:
        kind = InterfaceType.parse(spec.type)
        if kind.form is not Form.INTERFACE:
            raise ValueError(f"a container has no {spec.type}; use {kind.role.value}Interface")
        if not spec.addr or not names.is_graph_name(spec.addr):
            raise ValueError(f"addr {spec.addr!r} is not a ROS name; give the topic or service it stands for")
        if kind.role.is_service:
            self._types.service(spec.message_type)
        else:
            self._types.message(spec.message_type)
        return _KINDS[kind.role]
