"""Robots' topics in ROS graphs: the planner's, or each robot's own."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

from rce.ros.closing import release
from rce.ros.errors import MasterError, RosError
from rce.ros.multimaster.listing import list_masters
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce_fleet.station.layers.sources import LayerSource

if TYPE_CHECKING:
    from rce.ros.types import TypeRegistry
    from rce_fleet.station.layers.kinds import LayerTopic
    from rce_fleet.station.layers.sources import Take, Tell

_log = logging.getLogger(__name__)

NODE = "operator_station_layers"
KEEP_S = 1.0
"""How long the answer of discovery is kept for robots that may have moved."""


class RosLayerSource(LayerSource):
    """Subscribes in the planner's graph, or in the robot's own if discovery knows a master of its name.

    In the planner's graph, a robot's topics are in its namespace. In its own graph they may also be outside
    of it.

    Args:
        master_uri: The ROS master of the planner's graph.
        types: Knows the message types.
    """

    def __init__(self, master_uri: str, types: TypeRegistry) -> None:
        self._master_uri = master_uri
        self._types = types
        self._masters: dict[str, str] = {}
        """The robots' own masters by robot ID, as they were found last."""
        self._nodes: dict[str, Node] = {}
        """The station's node in each graph, by master."""
        self._users: Counter[str] = Counter()
        """Open topics in each graph."""
        self._listing = asyncio.Lock()
        self._listed_at = float("-inf")
        self._joining: dict[str, asyncio.Lock] = {}

    @asynccontextmanager
    async def open(self, robot: str, topic: LayerTopic, take: Take, tell: Tell) -> AsyncIterator[None]:
        """Receive a topic of a robot while the block runs."""
        own = await self._find_master(robot)
        outside = own is not None or topic.is_global
        names = [f"/{robot}/{name}" for name in topic.names]
        names += [f"/{name}" for name in topic.names if outside]
        async with AsyncExitStack() as stack:
            node = await stack.enter_async_context(self._joined(own or self._master_uri, robot))
            for name in names:
                subscriber = await node.subscribe_serialized(
                    name, topic.type_name, lambda payload, _: take(payload)
                )
                stack.push_async_callback(release, subscriber)
            tell("")
            yield

    @asynccontextmanager
    async def graph_of(self, robot: str) -> AsyncIterator[tuple[Node, str]]:
        """Give the station's node in a robot's graph, and the namespace of the robot's topics there.

        Raises:
            RosError: The graph cannot be reached.
        """
        own = await self._find_master(robot)
        async with self._joined(own or self._master_uri, robot) as node:
            yield node, "/" if own else f"/{robot}/"

    @asynccontextmanager
    async def _joined(self, uri: str, robot: str) -> AsyncIterator[Node]:
        """Give a node in a graph: one for all topics, as long as one of them is open."""
        joining = self._joining.setdefault(uri, asyncio.Lock())
        async with joining:
            if uri not in self._nodes:
                node = Node(
                    NODE,
                    anonymous=True,
                    argv=(),
                    master_uri=uri,
                    types=self._types,
                    signals=False,
                    master_timeout=0,
                    rosout=False,
                )
                try:
                    await node.__aenter__()
                except MasterError:
                    self._masters.pop(robot, None)  # The robot may come back elsewhere.
                    raise
                self._nodes[uri] = node
            self._users[uri] += 1
        try:
            yield self._nodes[uri]
        finally:
            self._users[uri] -= 1
            if not self._users[uri]:
                await self._nodes.pop(uri).__aexit__(None, None, None)

    async def look_again(self) -> None:
        """Read from discovery, at most once a second, where robots are that may have moved."""
        async with self._listing:
            now = asyncio.get_running_loop().time()
            if now - self._listed_at >= KEEP_S:
                self._listed_at = now
                await self._read_masters()

    async def find_subscribed(self, topic: str) -> set[str]:
        """Return the robots of the planner's graph where something subscribes to a topic.

        Raises:
            MasterError: The master does not answer.
        """
        async with RpcClient() as rpc:
            state = await MasterClient(self._master_uri, f"/{NODE}", "", rpc).call("getSystemState")
        names = [name.split("/", 2) for name, _ in state[1]]
        return {parts[1] for parts in names if parts[0] == "" and parts[2:] == [topic]}

    async def _find_master(self, robot: str) -> str | None:
        """Return the URI of the robot's own master; None if it is in the planner's graph."""
        if robot not in self._masters:
            await self._read_masters()
        return self._masters.get(robot)

    async def _read_masters(self) -> None:
        try:
            found = await list_masters(self._master_uri)
        except RosError as error:
            _log.debug("no robots with masters of their own: %s", error)
        else:
            self._masters |= {master.name: master.uri for master in found if master.online}
