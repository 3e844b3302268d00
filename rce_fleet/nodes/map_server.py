"""Publishes a map from a file: ROS 1's ``map_server map_server``.

``map_server MAP.yaml`` publishes ``map`` and ``map_metadata`` (latched) and answers the service
``static_map``. The service ``change_map`` loads another file. http://wiki.ros.org/map_server documents
them and the format.

A file that cannot be read is an error on ``/rosout`` and ``/diagnostics``; the node then waits for
``change_map``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce.ros.node import Message, Node, Publisher, ServiceFaultError, run
from rce.ros.node.hosting import program_arguments
from rce_fleet.exceptions import MapError
from rce_fleet.maps.ros_map import load_map
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.map_messages import map_fields, metadata_fields
from rce_fleet.nodes.parameters import read_parameters

if TYPE_CHECKING:
    from rce_fleet.maps.occupancy_map import OccupancyMap

USAGE = "usage: map_server MAP.yaml (a map file as of http://wiki.ros.org/map_server)"
REPORT_S = 5.0
"""Seconds between two messages on ``/diagnostics``."""
SUCCESS, NO_FILE, BAD_MAP = 0, 1, 2
"""Results of ``nav_msgs/LoadMap`` that are used here."""


@dataclass(frozen=True)
class MapServerParameters:
    """Parameters of the node.

    Attributes:
        frame_id: Frame of the published map.
        map_file: The map file, if the command line names none.
    """

    frame_id: str = "map"
    map_file: str = field(default="")


class MapServer:
    """A map in a ROS graph.

    Args:
        node: A running node.
        parameters: Its parameters.
    """

    def __init__(self, node: Node, parameters: MapServerParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._answer: dict[str, Any] | None = None
        self._state = Level.ERROR, "no map is loaded"
        self._maps: Publisher
        self._metadata: Publisher

    async def run(self, file: str) -> None:
        """Serve a map until the node is stopped.

        Args:
            file: The map file; empty: none yet.
        """
        node = self._node
        self._maps = await node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        self._metadata = await node.advertise("map_metadata", "nav_msgs/MapMetaData", latch=True)
        diagnostics = await Diagnostics.start(node, "map")
        await node.advertise_service("static_map", "nav_msgs/GetMap", self._give)
        await node.advertise_service("change_map", "nav_msgs/LoadMap", self._change)
        if file:
            await self._load(file)
        else:
            node.log.error("%s", USAGE)
            self._state = Level.ERROR, USAGE
        diagnostics.publish(*self._state, {})
        while await node.sleep(REPORT_S):
            diagnostics.publish(*self._state, {})

    async def _load(self, file: str) -> int:
        """Load and publish a map; return the result as of ``nav_msgs/LoadMap``."""
        try:
            grid = await asyncio.to_thread(load_map, file)
        except MapError as error:
            self._node.log.error("%s", error)  # noqa: TRY400 - the file's mistake
            if self._answer is None:
                self._state = Level.ERROR, str(error)
            return BAD_MAP if await asyncio.to_thread(Path(file).exists) else NO_FILE
        self._publish(grid)
        self._state = Level.OK, f"serves {file}"
        self._node.log.info("%s: %d x %d cells of %.3f m", file, grid.columns, grid.rows, grid.resolution)
        return SUCCESS

    def _publish(self, grid: OccupancyMap) -> None:
        now = self._node.now()
        self._answer = map_fields(grid, self._parameters.frame_id, now)
        self._maps.publish(self._answer)
        self._metadata.publish(metadata_fields(grid, now))

    def _give(self, _request: Message) -> dict[str, Any]:
        if self._answer is None:
            raise ServiceFaultError(self._node.resolve("static_map"), f"there is no map: {self._state[1]}")
        return {"map": self._answer}

    async def _change(self, request: Message) -> dict[str, Any]:
        result = await self._load(request.map_url.removeprefix("file://"))
        return {"result": result} if self._answer is None else {"result": result, "map": self._answer}


def arguments(argv: Sequence[str]) -> list[str]:
    """Return the words of a node's command line that are not remappings."""
    return [word for word in argv if ":=" not in word]


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("map_server") as node:
        parameters = await read_parameters(node, MapServerParameters)
        words = arguments(program_arguments())
        if len(words) > 1:
            node.log.error("expected one map file, found %s; %s", " ".join(words), USAGE)
        await MapServer(node, parameters).run(words[0] if words else parameters.map_file)


if __name__ == "__main__":
    run(main())
