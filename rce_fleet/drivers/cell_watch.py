"""Watches the cells that people block, so that the world puts boxes there.

Cells that a robot's sensors found blocked get no box: there is something already, or the sensor was wrong.
The fleet's grid may be changed while it drives: a message tells where its cells are.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol, TypeAlias

from rce.ros.node import Message, Node, TypeRegistry
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


CELLS = "std_msgs/Int32MultiArray"
TOPIC = "/fleet/requestedCells"
NODE = "world"


Follow: TypeAlias = "Callable[[list[int], GridMap | None], None]"
"""Called with all blocked cells and their grid, whenever they change; None: the planner does not tell."""


class CellWatch(Protocol):
    """Watches the planner's blocked cells."""

    joined: asyncio.Event
    """Set once the planner is connected."""

    async def run(self, follow: Follow) -> None:
        """Watch until cancelled; ``follow`` is called whenever the blocked cells or their grid change."""


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

    async def run(self, follow: Follow) -> None:
        """Watch until cancelled; ``follow`` is called whenever the blocked cells or their grid change."""

        def take(message: Message) -> None:
            follow([int(cell) for cell in message.data], grid_of([each.label for each in message.layout.dim]))
            self.joined.set()

        async with self._node as node:
            await node.subscribe(TOPIC, CELLS, take)
            await asyncio.Event().wait()


def grid_of(labels: Sequence[str]) -> GridMap | None:
    """Return the grid that a message's labels tell; None if they tell none, as planners before."""
    try:
        return GridMap.from_layout(labels[0]) if labels else None
    except ValueError:
        return None
