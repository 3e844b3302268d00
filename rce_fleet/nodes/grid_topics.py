"""The topics of the planner's grid: the map of cells, and cells that are blocked."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rce_fleet.nodes.grid_messages import GRID_TOPIC, OLD_TOPIC, grid_fields, grid_name, wants_old_topic

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce.ros.node import Node, Publisher
    from rce.ros.types import Time
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.nodes.graph_look import GraphState

OLD_TOPIC_LOOKS = 3
"""So many looks in a row must find only robot files from before on the old topic of the grid."""
LEAST_PAUSE = 0.1
"""Seconds between two messages of the grid at least, however many cells are blocked one by one."""
SEND_AGAIN = 5.0
"""Seconds between two messages of the grid for move clients that have another one."""


class GridTopics:
    """Publishes grid and blocked cells.

    Args:
        node: Running node.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._blocked: Publisher
        self._requested: Publisher
        self._map: Publisher
        self._old_map: Publisher | None = None
        self._shown_blocked: tuple[int, ...] = ()
        self._next_blocked: tuple[int, ...] | None = None
        """Blocked cells that are not published yet; None: those that were are as they are."""
        self._shown_requested: tuple[str, tuple[int, ...]] | None = None
        self._looks_for_old = 0
        self._sent_at = 0.0

    async def start(self) -> None:
        """Create the publishers. They end with the node."""
        cells, node = "std_msgs/Int32MultiArray", self._node
        self._blocked = await node.advertise("/fleet/blockedCells", cells, latch=True)
        self._requested = await node.advertise("/fleet/requestedCells", cells, latch=True)
        self._map = await node.advertise(GRID_TOPIC, "nav_msgs/OccupancyGrid", latch=True)

    def publish(self, state: FleetState, started: Time, cells: tuple[int, ...]) -> None:
        """Publish the grid with its blocked cells.

        Args:
            state: The fleet.
            started: When the planner took the grid; names it.
            cells: The blocked cells.
        """
        self._blocked.publish(data=list(cells))
        self._shown_blocked, self._next_blocked = cells, None
        self.publish_requested(state)
        fields = grid_fields(state.grid, cells, self._node.now(), started)
        for grids in (self._map, self._old_map):
            if grids is not None:
                grids.publish(fields)
        self._sent_at = time.monotonic()

    def change(self, cells: tuple[int, ...]) -> None:
        """Note other blocked cells, for the next :meth:`update`: a message has the whole grid."""
        self._next_blocked = cells

    def update(self, state: FleetState, started: Time) -> None:
        """Publish the grid if its blocked cells have changed, unless it was published just now.

        Args:
            state: The fleet.
            started: When the planner took the grid.
        """
        cells = self._next_blocked
        if cells is not None and time.monotonic() - self._sent_at >= LEAST_PAUSE:
            self.publish(state, started, cells)

    def publish_requested(self, state: FleetState) -> None:
        """Publish the blocked cells that people asked for, if they or the grid have changed.

        The label of the array's dimension is the grid's layout, which tells where the cells are.
        """
        requested = tuple(cell for cell in self._shown_blocked if cell in state.requested)
        shown = (state.grid.layout, requested)
        if shown != self._shown_requested:
            self._shown_requested = shown
            size = len(requested)
            dimension = {"label": state.grid.layout, "size": size, "stride": size}
            self._requested.publish(layout={"dim": [dimension]}, data=list(requested))

    def send_again(self, state: FleetState, started: Time, client_grids: Iterable[str]) -> None:
        """Publish the grid again if it did not arrive at a move client, which ignores all lists meanwhile.

        Args:
            state: The fleet.
            started: When the planner took the grid.
            client_grids: The grids that move clients have; empty names are not the planner's concern.
        """
        own = grid_name(started)
        is_missing = any(grid not in ("", own) for grid in client_grids)
        if is_missing and time.monotonic() - self._sent_at >= SEND_AGAIN:
            self._node.log.warning("a move client has another grid: the grid is sent again")
            self.publish(state, started, self._shown_blocked)

    async def serve_old_topic(self, graph: GraphState, state: FleetState, started: Time) -> None:
        """Publish the grid on the topic that robot files from before connect, while it has no other use.

        Args:
            graph: The topics of the ROS graph.
            state: The fleet.
            started: When the planner took the grid.
        """
        wanted = wants_old_topic(graph.publishers, graph.subscribers, self._node.name)
        self._looks_for_old = self._looks_for_old + 1 if wanted else 0
        if self._old_map is None and self._looks_for_old >= OLD_TOPIC_LOOKS:
            self._node.log.warning(
                "a robot file connects %s; the grid is now %s: change the file", OLD_TOPIC, GRID_TOPIC
            )
            self._old_map = await self._node.advertise(OLD_TOPIC, "nav_msgs/OccupancyGrid", latch=True)
            self.publish(state, started, self._shown_blocked)
        elif self._old_map is not None and set(graph.publishers.get(OLD_TOPIC, ())) - {self._node.name}:
            old, self._old_map = self._old_map, None
            await old.close()
