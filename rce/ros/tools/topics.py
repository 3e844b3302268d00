"""``topic list|info|type|echo|hz|pub``."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from rce.ros.errors import ToolError
from rce.ros.tools.graph import look, message_type
from rce.ros.tools.plain import as_json, as_yaml, read_fields

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.node import Node
    from rce.ros.node.master import MasterClient
    from rce.ros.types import Message, TypeRegistry
    from rce.ros.xmlrpc import RpcClient

WINDOW = 100
"""Number of messages over which the rate is measured."""
LATE_SUBSCRIBERS_S = 1.0
"""How long a single message waits for a subscriber, and stays for those that come at once."""


class ToolContext(NamedTuple):
    """The context of a command."""

    node: Node
    master: MasterClient
    rpc: RpcClient
    types: TypeRegistry
    show: Callable[[str], None]
    """Prints a line for the user."""


async def list_topics(context: ToolContext, *, verbose: bool) -> None:
    """Print all topics; if ``verbose`` with their types and how many nodes publish and subscribe."""
    graph = await look(context.master)
    for topic in graph.topics:
        if not verbose:
            context.show(topic)
            continue
        kind = graph.types.get(topic, "*")
        counts = f"{len(graph.publishers.get(topic, []))} pub, {len(graph.subscribers.get(topic, []))} sub"
        context.show(f"{topic} [{kind}] {counts}")


async def info(context: ToolContext, topic: str) -> None:
    """Print a topic's type and nodes."""
    graph, topic = await look(context.master), context.node.resolve(topic)
    context.show(f"Type: {graph.type_of(topic)}")
    for title, nodes in (("Publishers", graph.publishers), ("Subscribers", graph.subscribers)):
        context.show(f"{title}:")
        for node in nodes.get(topic, []):
            context.show(f" * {node}")


async def show_type(context: ToolContext, topic: str) -> None:
    """Print a topic's type."""
    context.show((await look(context.master)).type_of(context.node.resolve(topic)))


async def echo(
    context: ToolContext, topic: str, *, count: int, json: bool, whole: bool, no_arrays: bool
) -> None:
    """Print a topic's messages as they come.

    Args:
        context: What to work with.
        topic: The topic.
        count: End after so many; 0 for no end.
        json: One JSON object a line in place of YAML.
        whole: Long arrays whole.
        no_arrays: Leave arrays out.
    """
    name = context.node.resolve(topic)
    kind = await message_type(name, await look(context.master), context.master, context.rpc, context.types)
    seen = 0
    async for message in await context.node.subscribe(name, kind):
        if json:
            context.show(as_json(message))
        else:
            context.show(as_yaml(message, whole=whole, arrays=not no_arrays) + "---")
        seen += 1
        if seen == count:
            return


class Rate:
    """The rate of a topic, from when its messages came. Pure.

    Args:
        window: Of how many messages.
    """

    def __init__(self, window: int) -> None:
        self._times: deque[float] = deque(maxlen=max(window, 2))

    def note(self, now: float) -> None:
        """Note a message; ``now`` in seconds."""
        self._times.append(now)

    def describe(self) -> str:
        """Say the rate in words; empty if fewer than two messages came."""
        if len(self._times) < 2:  # noqa: PLR2004 - a rate needs two
            return ""
        times = list(self._times)
        gaps = [after - before for before, after in pairwise(times)]
        mean = sum(gaps) / len(gaps)
        deviation = (sum((gap - mean) ** 2 for gap in gaps) / len(gaps)) ** 0.5
        rate = f"{1 / mean:.3f}" if mean else "very high"
        return (
            f"average rate: {rate} Hz, gaps min {min(gaps):.4f} s max {max(gaps):.4f} s"
            f" std dev {deviation:.5f} s, window {len(times)}"
        )


async def hz(context: ToolContext, topic: str, *, window: int, interval: float, count: int) -> None:
    """Print a topic's rate every ``interval`` seconds, ``count`` times or without end."""
    rate, came = Rate(window), 0

    def take(_: bytes, __: bool) -> None:
        nonlocal came
        came += 1
        rate.note(time.monotonic())

    await context.node.subscribe_serialized(topic, "*", take)
    shown = before = 0
    while await _pause(context.node, interval):
        text = rate.describe() if came > before else ""
        context.show(text or "no new messages")
        before, shown = came, shown + 1
        if shown == count:
            return


async def publish(
    context: ToolContext, topic: str, kind: str, values: str, *, rate: float, latch: bool
) -> None:
    """Publish a message.

    Args:
        context: What to work with.
        topic: The topic.
        kind: Its type; empty for the one that the graph knows.
        values: The fields as YAML.
        rate: Times a second; 0 for once.
        latch: Keep the message for later subscribers until interrupted.

    Raises:
        ToolError: The values do not fit the type, or the type is not known.
    """
    name = context.node.resolve(topic)
    if kind:
        message_kind = context.types.message(kind)
    else:
        message_kind = await message_type(
            name, await look(context.master), context.master, context.rpc, context.types
        )
    try:
        message: Message = message_kind.new(**read_fields(values, message_kind))
    except ValueError as error:
        raise ToolError(f"the message for {name}: {error}") from error
    publisher = await context.node.advertise(name, message_kind, latch=latch or not rate)
    if rate:
        async for _ in context.node.rate(rate):
            publisher.publish(message)
        return
    publisher.publish(message)
    if latch:
        context.show("published and latched; interrupt to end")
        await context.node.spin()
        return
    try:
        await publisher.wait_for_subscribers(timeout=LATE_SUBSCRIBERS_S)
    except TimeoutError:
        context.show("published, but no node has subscribed")
    await _pause(context.node, LATE_SUBSCRIBERS_S)


async def _pause(node: Node, seconds: float) -> bool:
    """Wait in real time; returns False when the node was told to stop."""
    ended = asyncio.ensure_future(node.spin())
    done, _ = await asyncio.wait((ended,), timeout=seconds)
    ended.cancel()
    return not done
