"""The importing end of a relay: advertises the offer in its graph, and asks for the topics in use."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable

from rce.aio.tasks import finish
from rce.ros.closing import release_all
from rce.ros.errors import MasterError, RosError, ServiceFaultError
from rce.ros.multimaster.errors import LinkFullError
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.relay.exporter import CALL_TIMEOUT, Rename
from rce.ros.multimaster.relay.frames import NO_SOURCE, Answer, Call, Data, Frame, Offer, Sources, Want
from rce.ros.multimaster.relay.kinds import ServiceKind, TopicKind
from rce.ros.node import Node, Publisher, Service
from rce.ros.node.master import MasterClient

_log = logging.getLogger(__name__)

RETRY = 1.0
"""Seconds until something that could not be advertised is tried again."""

MAX_SOURCES = 1024
"""Publishers of one topic whose latched messages are kept for later subscribers."""


class Importer:
    """Advertises the other end's offer in one graph. A topic's messages come while it has subscribers."""

    def __init__(
        self,
        node: Node,
        master: MasterClient,
        chosen: SyncFilter,
        send: Callable[[Frame], None],
        *,
        rename: Rename = str,
    ) -> None:
        """Prepare an end.

        Args:
            node: Publishes and provides.
            master: The node's master.
            chosen: The filter of the offer, by the names in it.
            send: Takes frames for the other end; raises LinkFullError for a call that does not fit.
            rename: Gives the names of this graph.
        """
        self._node = node
        self._master = master
        self._chosen = chosen
        self._send = send
        self._rename = rename
        self._offer = Offer()
        self._topics: dict[int, tuple[str, TopicKind, Publisher]] = {}
        self._services: dict[int, tuple[str, ServiceKind, Service]] = {}
        self._calls: dict[int, asyncio.Future[bytes]] = {}
        self._numbers = itertools.count(1)
        self._wanted: frozenset[int] = frozenset()
        self._changed = asyncio.Event()
        self._complained: set[str] = set()

    async def run(self) -> None:
        """Keep the graph in step with the offers, until cancelled."""
        try:
            while True:
                self._changed.clear()
                has_topics, has_services = await self._keep_topics(), await self._keep_services()
                self._tell_wants()
                try:
                    async with asyncio.timeout(None if has_topics and has_services else RETRY):
                        await self._changed.wait()
                except TimeoutError:
                    continue
        finally:
            await finish(self._close())

    def take(self, frame: Frame) -> None:
        """Take a frame of the other end, if it is for this one."""
        if isinstance(frame, Data):
            self._publish(frame)
        elif isinstance(frame, Sources):
            self._retain(frame)
        elif isinstance(frame, Answer):
            waiting = self._calls.get(frame.call)
            if waiting is not None and not waiting.done():
                if frame.ok:
                    waiting.set_result(frame.payload)
                else:
                    waiting.set_exception(ServiceFaultError("", frame.payload.decode(errors="replace")))
        elif isinstance(frame, Offer):
            self._offer = frame
            self._changed.set()

    # Topics

    def _publish(self, data: Data) -> None:
        known = self._topics.get(data.topic)
        if known is None:
            return
        publisher = known[2]
        if data.source == NO_SOURCE:
            publisher.publish_serialized(data.payload)
        else:
            publisher.publish_serialized(data.payload, latch=True, source=str(data.source))
            if len(publisher.latched) > MAX_SOURCES:
                publisher.unlatch(next(iter(publisher.latched)))
        if publisher.connections == 0:
            self._changed.set()

    def _retain(self, frame: Sources) -> None:
        """Forget the latched messages of sources that are not in force any longer."""
        known = self._topics.get(frame.topic)
        if known is not None:
            publisher = known[2]
            for source in publisher.latched.keys() - set(map(str, frame.sources)):
                publisher.unlatch(source)

    def _tell_wants(self) -> None:
        wanted = frozenset(
            number for number, (_, _, publisher) in self._topics.items() if publisher.connections
        )
        if wanted != self._wanted:
            self._wanted = wanted
            self._send(Want(wanted))

    async def _keep_topics(self) -> bool:
        offered = self._offer.topics
        gone = [number for number, known in self._topics.items() if offered.get(number) != known[:2]]
        await release_all(self._topics.pop(number)[2] for number in gone)
        is_complete = True
        for number in offered.keys() - self._topics.keys():
            name, kind = offered[number]
            own_name = self._rename(name)
            if own_name is None or not self._chosen.takes_publisher("", name, kind.name):
                continue
            try:
                publisher = await self._node.advertise(own_name, kind.as_type())
            except RosError as error:
                self._complain(f"topic {own_name} is not relayed: {error}")
                is_complete = False
                continue
            publisher.on_subscriber = self._changed.set
            self._topics[number] = (name, kind, publisher)
            if publisher.connections:
                self._changed.set()
        return is_complete

    # Services

    async def _keep_services(self) -> bool:
        offered = self._offer.services
        gone = [number for number, known in self._services.items() if offered.get(number) != known[:2]]
        await release_all(self._services.pop(number)[2] for number in gone)
        is_complete = True
        for number in offered.keys() - self._services.keys():
            name, kind = offered[number]
            own_name = self._rename(name)
            if own_name is None or not self._chosen.takes_service("", name):
                continue
            try:
                service = await self._provide(number, own_name, kind)
            except RosError as error:
                self._complain(f"service {own_name} is not relayed: {error}")
                is_complete = False
                continue
            self._services[number] = (name, kind, service)
        return is_complete

    async def _provide(self, number: int, name: str, kind: ServiceKind) -> Service:
        # A registration of this node that was cancelled or lost its answer may still be there.
        if await self._master.lookup_service(name) not in (None, self._node.service_uri):
            raise MasterError("it is provided here already")

        async def handle(request: bytes) -> bytes:
            return await self._call(name, number, request)

        return await self._node.advertise_service_serialized(name, kind.as_type(), handle)

    async def _call(self, name: str, service: int, request: bytes) -> bytes:
        number = next(self._numbers) & 0xFFFFFFFF
        waiting: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._calls[number] = waiting
        try:
            self._send(Call(service, number, request))
            async with asyncio.timeout(CALL_TIMEOUT):
                return await waiting
        except TimeoutError as error:
            raise ServiceFaultError(name, "no answer came over the relay") from error
        except ServiceFaultError as error:
            raise ServiceFaultError(name, error.text) from error
        except LinkFullError as error:
            raise ServiceFaultError(name, str(error)) from error
        finally:
            del self._calls[number]

    # The end

    async def _close(self) -> None:
        for waiting in self._calls.values():
            if not waiting.done():
                waiting.set_exception(ServiceFaultError("", "the relay was closed"))
        # A message that still comes must not reach a closed publisher.
        topics, self._topics = self._topics, {}
        services, self._services = self._services, {}
        publishers = [publisher for _, _, publisher in topics.values()]
        await release_all([*publishers, *(service for _, _, service in services.values())])

    def _complain(self, text: str) -> None:
        if text not in self._complained:
            self._complained.add(text)
            _log.warning("%s", text)
