"""The move clients of many robots in one process; each robot's topics are in the robot's namespace.

The private parameter ``robots`` lists the namespaces. Everything else is as in
:mod:`rce_fleet.nodes.move_client`; ``share/README.md`` lists topics and parameters.
"""

from __future__ import annotations

import re
from itertools import cycle
from typing import Any

from rce.aio.tasks import run_in_groups
from rce.ros.node import Message, Node, run
from rce_fleet.nodes.grid_messages import GRID_TOPIC, read_grid
from rce_fleet.nodes.move_client import TICK, MoveClientNode
from rce_fleet.nodes.namespaced import NamespacedNode
from rce_fleet.nodes.registering import ROBOTS_AT_ONCE

TURNS = 4
"""The robots tick in so many turns, one after the other: a timer for each of them would cost more."""
_NAMESPACE = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def read_robots(value: Any) -> list[str]:
    """Return the namespaces of the robots.

    Raises:
        ValueError: The value is not a list of different namespaces.
    """
    expected = "the parameter ~robots must list the robots' namespaces, such as [Robot1, Robot2]"
    if not isinstance(value, list) or not value:
        raise ValueError(f"{expected}, not {value!r}")
    for name in value:
        if not isinstance(name, str) or _NAMESPACE.fullmatch(name) is None:
            raise ValueError(f"{expected}; {name!r} is not a namespace")
    if len(set(value)) < len(value):
        raise ValueError(f"{expected}, each once")
    return value


class MoveClients:
    """The move clients of robots that share a node. The grid is read once for all of them.

    Args:
        node: Running node.
        robots: Their namespaces.
    """

    def __init__(self, node: Node, robots: list[str]) -> None:
        self._node = node
        self._clients = [MoveClientNode(NamespacedNode(node, robot), hears_grid=False) for robot in robots]

    async def run(self) -> None:
        """Send the robots along until the node is stopped."""
        await run_in_groups([client.start for client in self._clients], ROBOTS_AT_ONCE)
        await self._node.subscribe(GRID_TOPIC, "nav_msgs/OccupancyGrid", self._take_map)
        for turn in cycle(range(TURNS)):
            if not await self._node.sleep(TICK / TURNS):
                return
            for client in self._clients[turn::TURNS]:
                client.tick()

    def _take_map(self, message: Message) -> None:
        try:
            grid = read_grid(message)
        except ValueError as error:
            self._node.log.warning("the grid on %s cannot be used: %s", GRID_TOPIC, error)
            return
        for client in self._clients:
            client.take_grid(grid, message.info.map_load_time)


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("move_clients") as node:
        try:
            robots = read_robots(await node.get_param("~robots", None))
        except ValueError as error:
            node.log.fatal("%s", error)
            raise SystemExit(1) from None
        await MoveClients(node, robots).run()


if __name__ == "__main__":
    run(main())
