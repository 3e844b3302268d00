"""A node's names below a namespace: what serves one of many robots in one node."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import logging

    from rce.ros.node import Node, Publisher, Subscriber
    from rce.ros.node.subscriber import MessageCallback, SerializedCallback
    from rce.ros.types import Time


class NamespacedNode:
    """Part of a running node: relative names are below a namespace, private ones are the node's own.

    Args:
        node: Running node.
        namespace: Such as ``Robot1``.
    """

    def __init__(self, node: Node, namespace: str) -> None:
        self._node = node
        self.namespace = f"/{namespace}/"

    @property
    def log(self) -> logging.Logger:
        """The node's log."""
        return self._node.log

    @property
    def name(self) -> str:
        """The node's global name."""
        return self._node.name

    @property
    def uri(self) -> str:
        """The URI of the node's own API."""
        return self._node.uri

    @property
    def master_uri(self) -> str:
        """The master's URI."""
        return self._node.master_uri

    async def advertise(self, topic: str, message_type: str, *, latch: bool = False) -> Publisher:
        """Publish on a topic; as :meth:`rce.ros.node.Node.advertise`."""
        return await self._node.advertise(self._full(topic), message_type, latch=latch)

    async def subscribe(self, topic: str, message_type: str, callback: MessageCallback) -> Subscriber:
        """Take the messages of a topic; as :meth:`rce.ros.node.Node.subscribe`."""
        return await self._node.subscribe(self._full(topic), message_type, callback)

    async def subscribe_serialized(
        self, topic: str, message_type: str, callback: SerializedCallback
    ) -> Subscriber:
        """Take the messages of a topic as they are; as :meth:`rce.ros.node.Node.subscribe_serialized`."""
        return await self._node.subscribe_serialized(self._full(topic), message_type, callback)

    async def get_param(self, name: str, default: Any) -> Any:
        """Return a parameter; as :meth:`rce.ros.node.Node.get_param`."""
        return await self._node.get_param(name, default)

    def now(self) -> Time:
        """Return the time."""
        return self._node.now()

    def time(self) -> float:
        """Return the time, seconds."""
        return self._node.time()

    async def sleep(self, seconds: float) -> bool:
        """Sleep; return whether the node still runs."""
        return await self._node.sleep(seconds)

    def _full(self, name: str) -> str:
        return name if name.startswith(("/", "~")) else self.namespace + name
