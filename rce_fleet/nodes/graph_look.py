"""Looks for robots in a ROS graph: by names of topics, which a master does not announce."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Self

from rce.ros.errors import MasterUnreachableError
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    from rce.ros.node import Node

TOPICS_PER_S = 1000
"""Topics that are looked at in a second, at most: master and node take about 30 us for each of them."""
CHANGING = 4
"""How many times more are looked at while the graph changes: robots then come together, and wait for it."""


class GraphState(NamedTuple):
    """The topics and services of a graph.

    Attributes:
        publishers: Names of the nodes that publish each topic.
        subscribers: Names of the nodes that subscribe to each topic.
        services: Name of the node that provides each service, in a list.
    """

    publishers: Mapping[str, list[str]]
    subscribers: Mapping[str, list[str]]
    services: Mapping[str, list[str]]


class GraphLook:
    """Asks a master for its topics again and again; in large graphs less often. An async context manager.

    Args:
        node: A running node.
        pause: Seconds between two looks at a small graph.
    """

    def __init__(self, node: Node, pause: float) -> None:
        self._node = node
        self._least = pause
        self._rpc = RpcClient()
        self._topics = 0
        self._is_changing = False

    async def __aenter__(self) -> Self:
        await self._rpc.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._rpc.__aexit__(kind, error, trace)

    @property
    def pause(self) -> float:
        """Seconds until the next look: half a second more for each 500 topics, or 2000 while they change."""
        rate = TOPICS_PER_S * (CHANGING if self._is_changing else 1)
        return self._least + self._topics / rate

    async def look(self) -> GraphState:
        """Return the topics and services that are there now.

        Raises:
            MasterError: The master cannot be asked.
        """
        node = self._node
        master = MasterClient(node.master_uri, node.name, node.uri, self._rpc)
        answer = await master.call("getSystemState")
        try:
            publishers, subscribers, services = (dict(part) for part in answer[:3])
        except (TypeError, ValueError) as error:
            raise MasterUnreachableError(node.master_uri, "its state has no known form") from error
        before, self._topics = self._topics, len(publishers) + len(subscribers)
        self._is_changing = self._topics != before
        return GraphState(publishers, subscribers, services)
