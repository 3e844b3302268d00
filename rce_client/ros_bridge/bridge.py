"""The bridge: each span connects an interface of the robot with a topic or service of its ROS graph."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from typing import TYPE_CHECKING, TypeVar, assert_never

from rce.aio.backoff import Backoff
from rce.model import Role
from rce.ros.closing import release
from rce.ros.errors import MasterUnreachableError
from rce.ros.node import MasterError, Node, RosError, TypeRegistry
from rce.ros.node import Publisher as RosPublisher
from rce_client.exceptions import CallError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Sequence

    from rce.aio.tasks import TaskScope
    from rce_client.connection import Connection
    from rce_client.own_interfaces import Serialized
    from rce_client.ros_bridge.plan import Plan, Span
    from rce_client.topics import Publisher

_log = logging.getLogger(__name__)

T = TypeVar("T")

MASTER_TIMEOUT = 2.0
"""Seconds between two attempts to reach the robot's ROS master."""

REMINDER = 5.0
"""Seconds between two messages about interfaces that are not connected yet."""

SHOWN_NAMES = 10
"""Most interfaces that such a message names: a file of many robots has hundreds."""

RETRY = Backoff(first=0.5, longest=10.0, jitter=0.5)
"""Pauses between attempts to register a topic or service at the robot's ROS master."""

CALL_TIMEOUT = 30.0
"""Seconds that a service of the robot's graph, or of the cloud, may take."""


@contextlib.asynccontextmanager
async def joined_graph(
    robot: str, master_uri: str, types: TypeRegistry, say: Callable[[str], None]
) -> AsyncIterator[Node]:
    """Start a node in the robot's ROS graph, once its master can be reached."""
    async with contextlib.AsyncExitStack() as stack:
        while True:
            node = Node(
                f"rce_ros_{robot}",
                argv=(),
                master_uri=master_uri,
                types=types,
                signals=False,
                master_timeout=MASTER_TIMEOUT,
            )
            try:
                await stack.enter_async_context(node)
                break
            except MasterError:
                say(f"waiting for the robot's ROS master at {master_uri}")
        yield node


async def build(plan: Plan, conn: Connection, node: Node, tasks: TaskScope) -> None:
    """Send all requests to the engine and create all spans; ``tasks`` runs what belongs to them.

    Raises:
        rce.ros.errors.RosError: The robot's ROS master refuses a registration.
        rce_client.exceptions.ClientError: The engine refuses the client.
    """
    for request in plan.requests[: plan.first]:
        await conn.request(request)
    for span in plan.spans:
        await lay(span, conn, node, tasks)
    for request in plan.requests[plan.first :]:
        await conn.request(request)


async def lay(span: Span, conn: Connection, node: Node, tasks: TaskScope) -> None:
    """Connect one interface with its topic or service. Messages are passed on unchanged."""
    size = span.queue_size or None
    match span.role:
        case Role.SUBSCRIBER:
            uplink = Uplink(
                conn, await conn.publisher(span.tag, span.message_type, raw=True, queue_size=size)
            )
            if span.on_demand:
                tasks.spawn(uplink.listen_on_demand(node, span), name=f"uplink {span.tag}")
            else:
                await _at_master(lambda: node.listen(span.addr, span.message_type, uplink))
        case Role.PUBLISHER:
            publisher = await _at_master(lambda: node.advertise(span.addr, span.message_type))
            downlink = Downlink(publisher)
            await conn.subscriber(
                span.tag,
                span.message_type,
                downlink.received,
                raw=True,
                queue_size=size,
                latches=downlink,
            )
        case Role.SERVICE_PROVIDER:
            client = await conn.service_client(span.tag, span.message_type, raw=True)

            async def ask_cloud(request: bytes) -> bytes:
                return bytes(await client(request, timeout=CALL_TIMEOUT))

            await _at_master(
                lambda: node.advertise_service_serialized(span.addr, span.message_type, ask_cloud)
            )
        case Role.SERVICE_CLIENT:
            service = node.service_client(span.addr, span.message_type)

            async def ask_robot(request: Serialized) -> bytes:
                try:
                    return bytes(await service.call_serialized(request, timeout=CALL_TIMEOUT))
                except RosError as error:  # its node is not there yet, or refuses the request
                    raise CallError(str(error)) from error

            await conn.service_provider(span.tag, span.message_type, ask_robot, raw=True)
        case _:
            assert_never(span.role)


async def _at_master(register: Callable[[], Awaitable[T]]) -> T:
    """Register at the robot's ROS master; wait while it is away, which may be since this program began."""
    pauses = RETRY.start()
    while True:
        try:
            return await register()
        except MasterUnreachableError as error:
            _log.warning("waiting for the robot's ROS master: %s", error)
        await asyncio.sleep(pauses.next())


class Uplink:
    """Sends a topic of the robot to the cloud, once its interface is connected there.

    The engine creates an interface some time after the request, and reports messages before that as errors.
    Latched messages wait until then; other messages would be out of date and are dropped.

    Implements :class:`rce.ros.node.subscriber.TopicListener`.

    Args:
        conn: The connection to the engine.
        publisher: Its interface.
    """

    def __init__(self, conn: Connection, publisher: Publisher[Serialized]) -> None:
        self._conn = conn
        self._publisher = publisher
        self._names: dict[str, str] = {}
        """By publisher of the robot's graph: what the engine is told of who it is."""
        self._numbers = itertools.count(1)

    async def listen_on_demand(self, node: Node, span: Span) -> None:
        """Subscribe to the topic whenever the interface is connected, until it is not, until cancelled.

        So a topic that the config offers, and that no other program uses now, costs nothing.
        """
        changed = asyncio.Event()
        needed = False
        pauses = RETRY.start()
        pause: float | None = None

        def take_demand(now: bool) -> None:
            nonlocal needed
            needed = now
            changed.set()

        self._publisher.watch_demand(take_demand)
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await changed.wait()
            changed.clear()
            pause = None
            if not needed:
                pauses.reset()
                continue
            try:
                subscriber = await node.listen(span.addr, span.message_type, self)
            except RosError as error:
                if isinstance(error, MasterError):  # the robot's master restarts, perhaps
                    pause = pauses.next()
                _log.warning("topic %s cannot be subscribed to: %s", span.addr, error)
                continue
            pauses.reset()
            try:
                while needed:
                    await changed.wait()
                    changed.clear()
            finally:
                await release(subscriber)
                self._names.clear()
                self._publisher.keep_latched(())

    def received(self, payload: bytes) -> None:
        """Send a message of the robot's graph."""
        if self._conn.active.get(self._publisher.tag, False):
            self._publisher.publish(payload)

    def received_latched(self, payload: bytes, source: str) -> None:
        """Send a latched message of the robot's graph, now and whenever the interface is joined again."""
        name = self._names.get(source)
        if name is None:
            name = self._names[source] = str(next(self._numbers))
        self._publisher.publish(bytes(payload), latch=name)

    def source_ended(self, source: str) -> None:
        """Remove what a publisher of the robot's graph latched."""
        self._names.pop(source, None)
        self._publisher.keep_latched(tuple(self._names.values()))


class Downlink:
    """Publishes a topic of the cloud in the robot's graph; latched messages stay latched.

    Implements :class:`rce_client.interfaces.LatchListener`.

    Args:
        publisher: Its topic in the robot's graph.
    """

    def __init__(self, publisher: RosPublisher) -> None:
        self._publisher = publisher

    def received(self, payload: Serialized) -> None:
        """Publish a message."""
        self._publisher.publish_serialized(payload)

    def received_latched(self, message: Serialized, source: str) -> None:
        """Publish a message, and keep it for nodes that subscribe later."""
        self._publisher.publish_serialized(message, latch=True, source=source)

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Remove what all other sources latched."""
        for source in self._publisher.latched.keys() - set(sources):
            self._publisher.unlatch(source)


def listed(names: Sequence[str]) -> str:
    """Return names for a line of a log: the first few, and how many more there are."""
    shown = ", ".join(names[:SHOWN_NAMES])
    return shown if len(names) <= SHOWN_NAMES else f"{shown} and {len(names) - SHOWN_NAMES} more"


async def wait_ready(plan: Plan, conn: Connection, say: Callable[[str], None]) -> None:
    """Wait until every interface that the config connects has its peer; log the missing ones.

    All requests are repeated from time to time: they may name what another robot creates later.
    """
    missing = sorted(plan.awaited)
    while missing:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(REMINDER):
                for tag in missing:
                    await conn.wait_active(tag)
        missing = sorted(tag for tag in plan.awaited if not conn.active.get(tag, False))
        if missing:
            say(f"waiting for interfaces: {listed(missing)}")
            await conn.repeat_requests()
