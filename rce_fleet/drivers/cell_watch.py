"""Watches the cells that people block, so that the world puts boxes there.

Cells that a robot's sensors found blocked get no box: there is something already, or the sensor was wrong.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol

from rce.ros.node import Node

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rce.ros.types import Message, TypeRegistry

CELLS = "std_msgs/Int32MultiArray"
TOPIC = "/fleet/requestedCells"
NODE = "world"


class CellWatch(Protocol):
    """Watches the planner's blocked cells."""

    joined: asyncio.Event
    """Set once the planner is connected."""

    async def run(self, follow: Callable[[list[int]], None]) -> None:
        """Watch until cancelled; ``follow`` is called with all blocked cells whenever they change."""


class GraphCellWatch:
    """Watches them in the planner's ROS graph.

    Args:
        master_uri: The graph's master, which may start later.
        types: Where message types come from.
    """

    def __init__(self, master_uri: str, types: TypeRegistry) -> None:
        self._node = Node(
            NODE, argv=(), master_uri=master_uri, types=types, signals=False, master_timeout=None
        )
        self.joined = asyncio.Event()

    async def run(self, follow: Callable[[list[int]], None]) -> None:
        """Watch until cancelled; ``follow`` is called with all blocked cells whenever they change."""

        def take(message: Message) -> None:
            follow(cells_of(message.data))
            self.joined.set()

        async with self._node as node:
            await node.subscribe(TOPIC, CELLS, take)
            await asyncio.Event().wait()


def cells_of(data: Iterable[int]) -> list[int]:
    """Return the cells of a message's array."""
    return [int(cell) for cell in data]
