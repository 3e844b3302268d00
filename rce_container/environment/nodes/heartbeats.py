"""Listens to the heartbeat topics of nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from rce.model import NodeSpec
from rce.ros import names
from rce_container.environment.graph import Graph, GraphError, Subscription
from rce_container.environment.nodes.launch import ros_name_of


class _Listening(NamedTuple):
    topic: str
    subscription: Subscription


class Heartbeats:
    """Subscribes to the heartbeat topics of a container's nodes, of any message type.

    Args:
        graph: The container's graph.
        on_beat: Takes the tag of a node that sent a heartbeat.
        on_fault: A topic cannot be listened to; a text for the user.
    """

    def __init__(self, graph: Graph, on_beat: Callable[[str], None], on_fault: Callable[[str], None]) -> None:
        self._graph = graph
        self._on_beat = on_beat
        self._on_fault = on_fault
        self._listening: dict[str, _Listening] = {}
        self._refused: dict[str, str] = {}
        """Topics that cannot be subscribed to, by the nodes' tags; reported to the user."""

    async def follow(self, specs: Iterable[NodeSpec]) -> None:
        """Listen to exactly the topics that these nodes name."""
        wanted = {spec.tag: spec for spec in specs if spec.heartbeat}
        for tag, listening in list(self._listening.items()):
            if tag not in wanted or listening.topic != topic_of(wanted[tag]):
                del self._listening[tag]
                await listening.subscription.close()
        self._refused = {tag: text for tag, text in self._refused.items() if tag in wanted}
        for tag, spec in wanted.items():
            if tag not in self._listening:
                await self._listen(tag, spec)

    async def _listen(self, tag: str, spec: NodeSpec) -> None:
        topic = topic_of(spec)
        if not topic or self._refused.get(tag) == topic:
            return
        try:
            subscription = await self._graph.listen(topic, lambda: self._on_beat(tag))
        except GraphError as error:
            self._refused[tag] = topic
            self._on_fault(f"node {tag}: its heartbeat {topic} cannot be listened to: {error}")
            return
        self._listening[tag] = _Listening(topic, subscription)


def topic_of(spec: NodeSpec) -> str:
    """Return the global name of a node's heartbeat topic, which may be relative or private to the node."""
    return names.resolve(spec.heartbeat, ros_name_of(spec))
