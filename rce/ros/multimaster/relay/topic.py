"""One topic under another name, in the same graph: what topic_tools' ``relay`` and ``throttle`` do."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from rce.ros.errors import NodeClosedError
from rce.ros.multimaster.errors import NothingToRelayError
from rce.ros.multimaster.relay.kinds import TopicKind, learn_topic
from rce.ros.multimaster.relay.throttle import Everything, Throttle
from rce.ros.multimaster.source import multicall
from rce.ros.node import Node, Publisher
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

_log = logging.getLogger(__name__)

LOOK_AGAIN = 0.5
"""Seconds between checks for a first publisher."""

QUEUE = 100


class TopicRelay:
    """Publishes under one name what is published under another, of whatever type.

    Attributes:
        passed: How many messages were passed on.
        held_back: How many the throttle stopped.
    """

    def __init__(
        self,
        source: str,
        target: str,
        *,
        throttle: Throttle | None = None,
        latch: bool = False,
        lazy: bool = False,
        wall_clock: bool = False,
    ) -> None:
        """Prepare a relay.

        Args:
            source: The topic to take.
            target: The topic to publish.
            throttle: Decides which messages are passed on; None: all.
            latch: Keep the last message for later subscribers. Without it, latched messages stay latched.
            lazy: Take messages only while the target has subscribers.
            wall_clock: The throttle counts in the machine's time, also where ROS time is simulated.
        """
        self.passed = 0
        self.held_back = 0
        self._source = source
        self._target = target
        self._throttle = throttle or Everything()
        self._latch = latch
        self._lazy = lazy
        self._wall_clock = wall_clock
        self._idle = asyncio.Event()
        self._publisher: Publisher
        self._now: Callable[[], float]

    async def run(self, node: Node) -> None:
        """Relay until cancelled, or until the node is told to stop while there are no subscribers.

        Raises:
            MasterError: The master does not answer any longer.
            ValueError: Both names mean one topic.
        """
        source, target = node.resolve(self._source), node.resolve(self._target)
        if source == target:
            raise ValueError(f"{source} cannot be relayed to itself")
        is_simulated = node.is_time_simulated and not self._wall_clock
        self._now = node.time if is_simulated else asyncio.get_running_loop().time
        kind = await self._learn(node, source)
        self._publisher = await node.advertise(target, kind.as_type(), latch=self._latch, queue_size=QUEUE)
        while True:
            if self._lazy:
                try:
                    await self._publisher.wait_for_subscribers()
                except NodeClosedError:
                    return
            self._idle.clear()
            subscriber = await node.listen(source, kind.as_type(), self)
            await self._idle.wait()
            await subscriber.close()
            if not self._latch:  # the next subscription brings the messages that are in force then
                for origin in list(self._publisher.latched):
                    self._publisher.unlatch(origin)

    # For the subscriber

    def received(self, payload: bytes) -> None:
        """Pass a message on."""
        self._pass_on(payload)

    def received_latched(self, payload: bytes, source: str) -> None:
        """Pass a latched message on; it stays latched beside those of other publishers."""
        self._pass_on(payload, latched=True, source=source)

    def source_ended(self, source: str) -> None:
        """Forget the latched message of a publisher that ended, unless the last one of all is kept anyway."""
        if not self._latch:
            self._publisher.unlatch(source)

    # Inside

    def _pass_on(self, payload: bytes, *, latched: bool = False, source: str = "") -> None:
        if self._lazy and self._publisher.connections == 0:
            self._idle.set()
            return
        if self._throttle.passes(self._now(), len(payload)):
            self.passed += 1
            self._publisher.publish_serialized(payload, latch=latched, source="" if self._latch else source)
        else:
            self.held_back += 1

    @staticmethod
    async def _learn(node: Node, topic: str) -> TopicKind:
        """Wait for a publisher and take the type from it."""
        reason = ""
        async with RpcClient() as rpc:
            master = MasterClient(node.master_uri, node.name, node.uri, rpc)
            while True:
                try:
                    return await learn_topic(rpc, node.name, topic, await publisher_uris(master, topic))
                except NothingToRelayError as error:
                    if str(error) != reason:
                        reason = str(error)
                        _log.info("%s", reason)
                await asyncio.sleep(LOOK_AGAIN)


async def publisher_uris(master: MasterClient, topic: str) -> list[str]:
    """Return the addresses of a topic's publishers.

    Raises:
        MasterError: The master does not answer.
    """
    publishers, _, _ = await master.call("getSystemState")
    nodes: list[str] = next((nodes for name, nodes in publishers if name == topic), [])
    uris = await multicall(master, [("lookupNode", node) for node in nodes if node != master.caller])
    return [uri for uri in uris if isinstance(uri, str)]
