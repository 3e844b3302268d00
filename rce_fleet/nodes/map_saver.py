"""Saves a map from a topic to files: ROS 1's ``map_server map_saver``.

``map_saver [-f NAME] [--occ PERCENT] [--free PERCENT] [map:=TOPIC]`` takes the next map, writes ``NAME.pgm``
and ``NAME.yaml``, and ends. http://wiki.ros.org/map_server documents it.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rce.ros.node import Message, Node, run
from rce.ros.node.hosting import program_arguments
from rce_fleet.exceptions import MapError
from rce_fleet.maps.occupancy_map import FREE_UP_TO, OCCUPIED_FROM
from rce_fleet.maps.ros_map import save_map
from rce_fleet.nodes.map_server import arguments
from rce_fleet.nodes.planar import read_map

if TYPE_CHECKING:
    from pathlib import Path


COMPLAIN_S = 5.0
"""Seconds of waiting after which the node says what it waits for."""


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line: ``file``, ``occ`` and ``free``; ends the program if it is wrong."""
    parser = argparse.ArgumentParser(prog="map_saver", description="Save a map from a topic to files.")
    parser.add_argument("-f", dest="file", default="map", metavar="NAME", help="name of the files")
    parser.add_argument(
        "--occ", type=int, default=OCCUPIED_FROM, metavar="PERCENT", help="values from here on are occupied"
    )
    parser.add_argument(
        "--free", type=int, default=FREE_UP_TO, metavar="PERCENT", help="values up to here are free"
    )
    options = parser.parse_args(arguments(argv))
    if not 0 <= options.free < options.occ <= 100:  # noqa: PLR2004 - percent
        parser.error(f"--free {options.free} and --occ {options.occ} must be within 0 .. 100, in this order")
    return options


async def save(node: Node, options: argparse.Namespace) -> Path | None:
    """Take the next map and write it; return ``NAME.yaml``, or None if that failed or the node was stopped.

    Args:
        node: A running node.
        options: As of :func:`parse`.
    """
    taken: asyncio.Future[Message] = asyncio.get_running_loop().create_future()

    def take(message: Message) -> None:
        if not taken.done():
            taken.set_result(message)

    topic = node.resolve("map")
    await node.subscribe("map", "nav_msgs/OccupancyGrid", take)
    node.log.info("waiting for a map on %s", topic)
    stopped = asyncio.ensure_future(node.spin())
    try:
        while not taken.done():
            await asyncio.wait((taken, stopped), timeout=COMPLAIN_S, return_when=asyncio.FIRST_COMPLETED)
            if stopped.done():
                return None
            if not taken.done():
                node.log.warning("no map on %s yet; does a map_server or SLAM node publish it?", topic)
    finally:
        stopped.cancel()
    try:
        grid = read_map(taken.result())
        written = await asyncio.to_thread(
            save_map, grid, options.file, occupied_from=options.occ, free_up_to=options.free
        )
    except (MapError, ValueError) as error:
        node.log.error("the map is not saved: %s", error)  # noqa: TRY400 - a trace would not help
        return None
    node.log.info("%d x %d cells written to %s", grid.columns, grid.rows, written)
    return written


async def main() -> int:
    """Save a map; return the program's status."""
    options = parse(program_arguments())
    async with Node("map_saver", anonymous=False) as node:
        return 0 if await save(node, options) else 1


if __name__ == "__main__":
    sys.exit(run(main()))
