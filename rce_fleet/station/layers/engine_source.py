"""Robots' topics through the engine: the station connects the interfaces that offer them, while needed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

from rce.aio.tasks import TaskScope
from rce_client.exceptions import ClientError
from rce_fleet.station.layers.frames import LayerError
from rce_fleet.station.layers.sources import LayerSource

if TYPE_CHECKING:
    from rce_client.connection import Connection
    from rce_client.topics import Subscriber
    from rce_fleet.station.layers.kinds import LayerTopic
    from rce_fleet.station.layers.sources import Take, Tell

CHECK_S = 3.0
"""How often a missing connection is made again: a robot that restarts removes its interfaces."""

ReadItems = Callable[[str], Awaitable[list[dict[str, Any]]]]
"""Returns the user's items of a kind, such as ``interfaces``, from the master's REST API."""


class EngineLayerSource(LayerSource):
    """Connects interfaces named ``layer_ROBOT_KEY`` of robots and containers.

    Where none is offered, it makes one in the container whose nodes run in the robot's namespace, and
    removes it afterwards.

    Args:
        connection: Returns the station's connection; None while there is none.
        read_items: Reads the user's items.
    """

    def __init__(self, connection: Callable[[], Connection | None], read_items: ReadItems) -> None:
        self._connection = connection
        self._read_items = read_items

    @asynccontextmanager
    async def open(self, robot: str, topic: LayerTopic, take: Take, tell: Tell) -> AsyncIterator[None]:
        """Receive a topic of a robot while the block runs."""
        connection = self._connection()
        if connection is None:
            raise LayerError("the engine is not connected yet")
        tag = topic.interface_tag(robot)
        is_offered = bool(await self._find_interfaces(tag))
        container = None if is_offered else await self._find_container(robot)
        if not is_offered and container is None:
            raise LayerError(
                f"{robot} does not offer {topic.names[0]}: add the interface {tag} to its config (see the"
                " documentation of the page's layers)"
            )
        subscriber = await connection.subscriber(tag, topic.type_name, take, raw=True)
        try:
            if container is not None:
                await connection.add_interface(
                    container, tag, "SubscriberInterface", topic.type_name, addr=f"/{robot}/{topic.names[0]}"
                )
            async with TaskScope() as tasks:
                tasks.spawn(self._keep_connected(connection, robot, tag, tell), name=f"connect {tag}")
                yield
        finally:
            await _withdraw(connection, subscriber, container, tag)

    async def _keep_connected(self, connection: Connection, robot: str, tag: str, tell: Tell) -> None:
        """Connect the interface whenever it is not connected."""
        while True:
            if connection.is_active(tag):
                tell("")
                await asyncio.sleep(CHECK_S)
                continue
            with suppress(LayerError, ClientError):
                endpoints = await self._find_interfaces(tag)
                if not endpoints:
                    tell(f"{robot} does not offer it any more; waiting for the interface {tag}")
                for endpoint in endpoints:
                    await connection.connect(f"{connection.robot_id}/{tag}", f"{endpoint}/{tag}")
            with suppress(TimeoutError):
                await connection.wait_active(tag, CHECK_S)

    async def _find_interfaces(self, tag: str) -> list[str]:
        """Return the robots and containers that have an interface; the station's own does not count.

        Transforms of an off-loaded robot come from the robot and from its container.
        """
        connection = self._connection()
        own = "" if connection is None else connection.robot_id
        items = await self._read_items("interfaces")
        return [str(item["endpoint"]) for item in items if item["tag"] == tag and item["endpoint"] != own]

    async def _find_container(self, robot: str) -> str | None:
        """Return the container with nodes in the robot's namespace."""
        for item in await self._read_items("nodes"):
            if item["namespace"].strip("/") == robot:
                return str(item["container"])
        return None


async def _withdraw(
    connection: Connection, subscriber: Subscriber[Any], container: str | None, tag: str
) -> None:
    """Remove the station's interface, and the container's if the station made it."""
    with suppress(ClientError):
        await subscriber.close()
        if container is not None:
            await connection.remove_interface(container, tag)
