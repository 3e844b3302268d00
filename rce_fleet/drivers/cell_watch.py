"""How the world hears of cells that the planner blocks: they get a box."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol

from rce.ros.node import Node

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rce.ros.types import Message, TypeRegistry

CELLS = "std_msgs/Int32MultiArray"
TOPIC = "/fleet/blockedCells"
NODE = "world"


class CellWatch(Protocol):
    """Hears the planner's blocked cells, for as long as it runs."""

    joined: asyncio.Event
    """Set once the planner can be heard."""

    async def run(self, follow: Callable[[list[int]], None]) -> None:
        """Watch until cancelled; ``follow`` gets all cells that are blocked now, whenever they change."""


class GraphCellWatch:
    """Hears them in the planner's ROS graph.

    Args:
        master_uri: The graph's master, which need not be up yet.
        types: Where message types come from.
    """

    def __init__(self, master_uri: str, types: TypeRegistry) -> None:
        self._node = Node(
            NODE, argv=(), master_uri=master_uri, types=types, signals=False, master_timeout=None
        )
        self.joined = asyncio.Event()

    async def run(self, follow: Callable[[list[int]], None]) -> None:
        """Watch until cancelled; ``follow`` gets all cells that are blocked now, whenever they change."""

        def take(message: Message) -> None:
            follow(cells_of(message.data))
            self.joined.set()

        async with self._node as node:
            await node.subscribe(TOPIC, CELLS, take)
            await asyncio.Event().wait()


def cells_of(data: Iterable[int]) -> list[int]:
    """The cells of a message's array."""
    return [int(cell) for cell in data]
