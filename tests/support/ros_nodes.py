"""What fixtures that make nodes give: a function that makes one of a name, at the master of the test.

And what tests do with those nodes.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Protocol, TypedDict, Unpack

from rce.ros.node import Node, Publisher, Subscriber
from rce.ros.types import TypeRegistry
from support.ros_real import Graph


class NodeOptions(TypedDict, total=False):
    """Keywords of :class:`rce.ros.node.Node` that tests give."""

    namespace: str
    argv: Sequence[str]
    types: TypeRegistry
    master_timeout: float | None
    intra_process: bool
    rosout: bool


class MakeNode(Protocol):
    """Makes a node at the core of the test: ``make_node("a")``."""

    def __call__(self, name: str, **options: Unpack[NodeOptions]) -> Node:
        """Make a node; it starts when it is entered."""


class MakeGraphNode(Protocol):
    """Makes a node of ours in a graph of real nodes: ``make_node(graph, "a")``."""

    def __call__(self, graph: Graph, name: str, **options: Unpack[NodeOptions]) -> Node:
        """Make a node; it starts when it is entered."""


async def say_until_echoed(say: Publisher, echo: Subscriber, timeout: float = 60.0) -> None:
    """Publish a ``std_msgs/String`` until it comes back, and take all copies of it from the echo.

    To be connected is not enough: rospy greets a subscriber before it counts it among those who get messages.

    Raises:
        TimeoutError: Nothing came back within ``timeout`` seconds.
    """
    async with asyncio.timeout(timeout):
        await say.wait_for_subscribers()
        await echo.wait_for_publishers()
        first = asyncio.ensure_future(anext(aiter(echo)))
        try:
            while not first.done():
                say.publish(data="anybody there?")
                await asyncio.sleep(0.05)
        finally:
            first.cancel()
        say.publish(data="begin")
        while (await anext(aiter(echo))).data != "begin":
            pass


async def collect(subscriber: Subscriber, count: int) -> list[str]:
    """Return the data of the next messages."""
    found = []
    async with asyncio.timeout(60):
        async for message in subscriber:
            found.append(message.data)
            if len(found) == count:
                break
    return found
