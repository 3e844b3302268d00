"""The exporting end of a relay: offers the topics and services of a graph, sends what the importer wants."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

from rce.aio.tasks import TaskScope, finish
from rce.ros.closing import release_all
from rce.ros.errors import InvalidNameError, RosError, ServiceError, TypeMismatchError
from rce.ros.multimaster.errors import LinkFullError, NothingToRelayError
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.relay.connection import SHORT
from rce.ros.multimaster.relay.frames import NO_SOURCE, Answer, Call, Data, Frame, Offer, Sources, Want
from rce.ros.multimaster.relay.kinds import ServiceKind, TopicKind, learn_service, learn_topic
from rce.ros.multimaster.relay.learning import Learning, Question
from rce.ros.multimaster.source import RpcSource, Snapshot
from rce.ros.node import Node, ServiceClient, Subscriber
from rce.ros.node.master import MasterClient

_log = logging.getLogger(__name__)

PERIOD = 1.0
"""Seconds between checks of the graph."""

CALL_TIMEOUT = 60.0
MAX_CALLS = 256
"""How many calls of the other end are under way at once; more are refused."""

Rename = Callable[[str], str | None]
"""Turns a name of this graph into the one to offer; None: not offered."""


K = TypeVar("K", TopicKind, ServiceKind)


@dataclass(frozen=True, slots=True)
class _Offered(Generic[K]):
    """A topic or service that is offered."""

    number: int
    kind: K
    origins: frozenset[str]
    """The URIs of the publishers, or of the provider, when the type was learned."""
    type_name: str = ""
    """A topic's type as the master named it then."""


class Exporter:
    """Offers the topics and services of one graph, as far as they pass a filter."""

    def __init__(
        self,
        node: Node,
        master: MasterClient,
        chosen: SyncFilter,
        send: Callable[[Frame], None],
        tasks: TaskScope,
        *,
        rename: Rename = str,
        foreign: Callable[[], Iterable[str]] = tuple,
    ) -> None:
        """Prepare an end.

        Args:
            node: Subscribes and calls.
            master: The node's master.
            chosen: The filter, by the names that topics and services are offered under.
            send: Takes frames for the other end; raises LinkFullError for an answer that does not fit.
            tasks: Owns the calls, and the questions for types.
            rename: Gives the names to offer.
            foreign: Returns the nodes that a synchronization registered; their topics and services are not
                offered.
        """
        self._node = node
        self._master = master
        self._chosen = chosen
        self._send = send
        self._tasks = tasks
        self._rename = rename
        self._foreign = foreign
        self._source = RpcSource(master)
        self._topics: dict[str, _Offered[TopicKind]] = {}
        self._services: dict[str, _Offered[ServiceKind]] = {}
        self._topic_kinds = Learning[TopicKind](tasks)
        self._service_kinds = Learning[ServiceKind](tasks)
        self._names: dict[int, str] = {}
        self._offered = Offer()
        self._next = 0
        self._wanted: frozenset[int] = frozenset()
        self._subscribers: dict[int, Subscriber] = {}
        self._senders: dict[int, _TopicSender] = {}
        self._source_numbers = itertools.count(NO_SOURCE + 1)
        self._clients: dict[int, ServiceClient] = {}
        self._changed = asyncio.Event()
        self._calls = 0
        self._complained: set[str] = set()

    async def run(self) -> None:
        """Offer topics and services, and send the wanted messages, until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                # Apart: a master that answers slowly delays only what is new, not what is wanted.
                group.create_task(self._keep_looking())
                group.create_task(self._keep_serving())
        finally:
            await finish(self._close())

    def take(self, frame: Frame) -> None:
        """Take a frame of the other end, if it is for this one."""
        if isinstance(frame, Want):
            self._wanted = frame.topics
            self._changed.set()
        elif isinstance(frame, Call):
            if self._calls >= MAX_CALLS:
                self._send(Answer(frame.call, ok=False, payload=b"too many calls at once"))
                return
            self._calls += 1
            self._tasks.spawn(self._call(frame), name="relayed call")

    # The offer

    async def _keep_looking(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            next_look = loop.time() + PERIOD
            try:
                await self._look()
            except RosError as error:
                _log.info("%s", error)
            await asyncio.sleep(next_look - loop.time())

    async def _look(self) -> None:
        snapshot = await self._source.read()
        foreign = {self._node.name, *self._foreign()}
        await self._update_topics(snapshot, foreign)
        await self._update_services(snapshot, foreign)
        offer = Offer(
            {one.number: (self._offered_name(name), one.kind) for name, one in self._topics.items()},
            {one.number: (self._offered_name(name), one.kind) for name, one in self._services.items()},
        )
        if offer != self._offered:
            self._offered = offer
            self._changed.set()
            self._send(offer)

    async def _update_topics(self, snapshot: Snapshot, foreign: set[str]) -> None:
        found: dict[str, list[str]] = {}
        for topic, nodes in snapshot.publishers.items():
            name, kind = self._rename(topic), snapshot.topic_types.get(topic, "")
            uris = [
                snapshot.node_uris[node]
                for node in nodes
                if name is not None
                and node in snapshot.node_uris
                and node not in foreign
                and self._chosen.takes_publisher(node, name, kind)
            ]
            if uris:
                found[topic] = uris
        self._forget(self._topics, found)
        questions: dict[str, Question[TopicKind]] = {}
        for topic, uris in found.items():
            known, type_name = self._topics.get(topic), snapshot.topic_types.get(topic, "")
            if known is None or not known.origins <= set(uris) or known.type_name != type_name:
                ask = partial(learn_topic, self._master.rpc, self._node.name, topic, uris)
                questions[topic] = Question(frozenset(uris), ask, type_name)
        for topic, (question, learned) in (await self._topic_kinds.learn(questions)).items():
            number = self._number(topic, learned, self._topics.get(topic))
            self._topics[topic] = _Offered(number, learned, question.origins, question.type_name)

    async def _update_services(self, snapshot: Snapshot, foreign: set[str]) -> None:
        found: dict[str, str] = {}
        for service, nodes in snapshot.services.items():
            name, address = self._rename(service), snapshot.service_uris.get(service)
            if name is None or address is None or foreign & set(nodes):
                continue
            if all(self._chosen.takes_service(node, name) for node in nodes):
                found[service] = address
        self._forget(self._services, found)
        questions: dict[str, Question[ServiceKind]] = {}
        for service, address in found.items():
            known = self._services.get(service)
            if known is None or address not in known.origins:
                ask = partial(learn_service, self._node.name, service, address)
                questions[service] = Question(frozenset((address,)), ask)
        for service, (question, learned) in (await self._service_kinds.learn(questions)).items():
            number = self._number(service, learned, self._services.get(service))
            self._services[service] = _Offered(number, learned, question.origins)

    def _forget(self, known: dict[str, _Offered[K]], found: Mapping[str, object]) -> None:
        for name in known.keys() - found.keys():
            self._void(known.pop(name).number)

    def _void(self, number: int) -> None:
        del self._names[number]
        self._changed.set()

    def _number(self, name: str, kind: K, known: _Offered[K] | None) -> int:
        """Return the number to offer a name under: the known one, unless the type is another one now."""
        if known is not None:
            if known.kind == kind:
                return known.number
            self._void(known.number)
        self._next += 1
        self._names[self._next] = name
        return self._next

    def _offered_name(self, name: str) -> str:
        return self._rename(name) or name

    # Wanted messages and calls

    async def _keep_serving(self) -> None:
        while True:
            self._changed.clear()
            try:
                await self._serve_wants()
            except RosError as error:
                _log.info("%s", error)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PERIOD):
                    await self._changed.wait()

    async def _serve_wants(self) -> None:
        unwanted = self._subscribers.keys() - (self._wanted & self._names.keys())
        await release_all(self._subscribers.pop(number) for number in unwanted)
        for number in unwanted:
            self._senders.pop(number).end()
        for number in self._clients.keys() - self._names.keys():
            await self._clients.pop(number).close()
        kinds = {one.number: (topic, one.kind) for topic, one in self._topics.items()}
        for number in (self._wanted & kinds.keys()) - self._subscribers.keys():
            topic, kind = kinds[number]
            sender = _TopicSender(number, self._source_numbers, self._send)
            try:
                self._subscribers[number] = await self._node.listen(topic, kind.as_type(), sender)
                self._senders[number] = sender
            except (InvalidNameError, TypeMismatchError) as error:
                self._complain(f"topic {topic} is not relayed: {error}")

    async def _call(self, call: Call) -> None:
        try:
            # A response that does not fit into a connection that is full is an error, too.
            response = await self._client(call.service).call_serialized(call.payload, timeout=CALL_TIMEOUT)
            self._send(Answer(call.call, ok=True, payload=response))
        except RosError as error:
            self._refuse(call, error.text if isinstance(error, ServiceError) else str(error))
        finally:
            self._calls -= 1

    def _refuse(self, call: Call, reason: str) -> None:
        text = reason.encode()
        try:
            self._send(Answer(call.call, ok=False, payload=text))
        except LinkFullError:
            self._send(Answer(call.call, ok=False, payload=text[:SHORT]))

    def _client(self, number: int) -> ServiceClient:
        client = self._clients.get(number)
        if client is None:
            for service, one in self._services.items():
                if one.number == number:
                    client = self._clients[number] = self._node.service_client(service, one.kind.as_type())
                    break
            else:
                raise NothingToRelayError("the service is not offered any longer")
        return client

    async def _close(self) -> None:
        self._topic_kinds.close()
        self._service_kinds.close()
        for client in self._clients.values():
            await client.close()
        await release_all(self._subscribers.values())

    def _complain(self, text: str) -> None:
        if text not in self._complained:
            self._complained.add(text)
            _log.warning("%s", text)


class _TopicSender:
    """Sends the messages of one topic while it is subscribed to; numbers the sources of the latched ones."""

    def __init__(self, topic: int, numbers: Iterator[int], send: Callable[[Frame], None]) -> None:
        self._topic = topic
        self._numbers = numbers
        self._send = send
        self._sources: dict[str, int] = {}

    def received(self, payload: bytes) -> None:
        """Send a message."""
        self._send(Data(self._topic, NO_SOURCE, payload))

    def received_latched(self, payload: bytes, source: str) -> None:
        """Send a latched message."""
        number = self._sources.get(source)
        if number is None:
            number = self._sources[source] = next(self._numbers)
        self._send(Data(self._topic, number, payload))

    def source_ended(self, source: str) -> None:
        """Tell the other end that a publisher's latched message is void."""
        if self._sources.pop(source, None) is not None:
            self._send(Sources(self._topic, frozenset(self._sources.values())))

    def end(self) -> None:
        """Tell the other end that all are void: the next subscription brings those that are in force then."""
        if self._sources:
            self._sources.clear()
            self._send(Sources(self._topic))
