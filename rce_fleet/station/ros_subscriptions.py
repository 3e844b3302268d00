"""Subscriptions in ROS graphs whose master may be away for a while."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

from rce.aio.backoff import Backoff
from rce.ros.errors import MasterError

if TYPE_CHECKING:
    from rce.ros.node import Node, Subscriber
    from rce.ros.types import Message

_log = logging.getLogger(__name__)

RETRY = Backoff(first=0.2, longest=5.0, jitter=0.5)
"""Pauses between attempts."""


async def subscribe_when_reachable(
    node: Node, topic: str, type_name: str, take: Callable[[Message], None]
) -> Subscriber:
    """Subscribe to a topic; wait for a ROS master that is away, which most of the station does not need.

    A node registers by itself again what a restarted master does not know. A new subscription fails at once.

    Args:
        node: The running node.
        topic: The topic.
        type_name: Its message type.
        take: Called with each message.
    """
    pauses = RETRY.start()
    while True:
        try:
            return await node.subscribe(topic, type_name, take)
        except MasterError as error:
            _log.info("%s is not subscribed to yet: %s", topic, error)
        await asyncio.sleep(pauses.next())
