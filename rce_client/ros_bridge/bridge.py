"""The bridge: each span joins an interface of the robot with a topic or service of its ROS graph."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from rce.protocol.names import Role
from rce.ros.errors import MasterError
from rce.ros.node import Node
from rce_client.exceptions import ClientError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rce.ros.types import TypeRegistry
    from rce_client.connection import Connection
    from rce_client.ends import Publisher
    from rce_client.ros_bridge.plan import Plan, Span

MASTER_PATIENCE = 2.0
"""Seconds between two looks for the robot's ROS master."""

REMINDER = 5.0
"""Seconds between two messages that tell which interfaces are still waited for."""

CALL_TIMEOUT = 30.0
"""Seconds that a service of the robot's graph, or of the cloud, may take."""


@contextlib.asynccontextmanager
async def joined_graph(
    robot: str, master_uri: str, types: TypeRegistry, say: Callable[[str], None]
) -> AsyncIterator[Node]:
    """Be a node of the robot's ROS graph, once its master is there."""
    async with contextlib.AsyncExitStack() as stack:
        while True:
            node = Node(
                f"rce_ros_{robot}",
                argv=(),
                master_uri=master_uri,
                types=types,
                signals=False,
                master_timeout=MASTER_PATIENCE,
            )
            try:
                await stack.enter_async_context(node)
                break
            except MasterError:
                say(f"waiting for the robot's ROS master at {master_uri}")
        yield node


async def build(plan: Plan, conn: Connection, node: Node) -> None:
    """Ask the engine for everything and lay all spans.

    Raises:
        rce.ros.errors.RosError: The robot's graph does not take part.
        rce_client.exceptions.ClientError: The engine does not.
    """
    for request in plan.requests[: plan.first]:
        await conn.request(request)
    for span in plan.spans:
        await lay(span, conn, node)
    for request in plan.requests[plan.first :]:
        await conn.request(request)


async def lay(span: Span, conn: Connection, node: Node) -> None:
    """Join one interface with its topic or service. Messages are passed on as they are."""
    match span.role:
        case Role.SUBSCRIBER:
            uplink = Uplink(conn, await conn.publisher(span.tag, span.cls, raw=True))
            await node.subscribe_serialized(span.addr, span.cls, uplink.send, hears_own=False)
        case Role.PUBLISHER:
            publisher = await node.advertise(span.addr, span.cls)
            await conn.subscriber(span.tag, span.cls, publisher.publish_serialized, raw=True)
        case Role.SERVICE_PROVIDER:
            client = await conn.service_client(span.tag, span.cls, raw=True)

            async def ask_cloud(request: bytes) -> bytes:
                return bytes(await client(request, timeout=CALL_TIMEOUT))

            await node.advertise_service_serialized(span.addr, span.cls, ask_cloud)
        case Role.SERVICE_CLIENT:
            service = node.service_client(span.addr, span.cls)

            async def ask_robot(request: bytes) -> bytes:
                return bytes(await service.call_serialized(request, timeout=CALL_TIMEOUT))

            await conn.service_provider(span.tag, span.cls, ask_robot, raw=True)


class Uplink:
    """A topic of the robot on its way to the cloud, where nothing is sent before somebody hears it.

    The engine makes an interface some time after it was asked to, and would complain of messages before. A
    latched message waits for its time; any other would be out of date by then.

    Args:
        conn: What it goes over.
        publisher: Its interface.
    """

    def __init__(self, conn: Connection, publisher: Publisher[bytes]) -> None:
        self._conn = conn
        self._publisher = publisher
        self._latched: bytes | None = None

    def send(self, payload: bytes, latched: bool) -> None:
        """Take a message of the robot's graph."""
        if self._conn.active.get(self._publisher.tag, False):
            self._publisher.publish(payload)
        elif latched:
            if self._latched is None:
                self._conn.spawn(self._send_latched())
            self._latched = bytes(payload)

    async def _send_latched(self) -> None:
        with contextlib.suppress(ClientError):  # closed for good: nobody will hear it
            await self._publisher.wait_active()
            if self._latched is not None:
                self._publisher.publish(self._latched)
        self._latched = None


async def wait_ready(plan: Plan, conn: Connection, say: Callable[[str], None]) -> None:
    """Wait until every interface that the config connects is joined with its peer; tell what is missing.

    Everything is asked for again now and then, because it may name what another robot makes a little later.
    """
    missing = sorted(plan.awaited)
    while missing:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(REMINDER):
                for tag in missing:
                    await conn.wait_active(tag)
        missing = sorted(tag for tag in plan.awaited if not conn.active.get(tag, False))
        if missing:
            say(f"waiting for interfaces: {', '.join(missing)}")
            await conn.repeat_requests()
