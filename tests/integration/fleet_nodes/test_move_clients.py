"""The move clients of many robots in one node."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from itertools import pairwise

import pytest

from rce.ros.core import Core
from rce.ros.node import Message, Node
from rce_fleet.coordination.answers import numbered_array
from rce_fleet.nodes import move_client, move_clients
from rce_fleet.nodes.grid_messages import grid_fields
from rce_fleet.nodes.move_clients import MoveClients
from rce_fleet.planning.grid import GridMap

PATIENCE = 60.0
GRID = GridMap(3, 4, 0.5)
ROBOTS = ["Robot1", "Robot2", "Robot3", "Robot4", "Robot5"]


async def test_each_robot_reports_often_while_it_makes_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the messages of a thousand robots said only that nothing had changed."""
    monkeypatch.setattr(move_clients, "TICK", 0.05)
    monkeypatch.setattr(move_client, "REPORT_EVERY", 0.05)
    monkeypatch.setattr(move_client, "QUIET_AFTER", 0.5)
    monkeypatch.setattr(move_client, "REPORT_QUIET_EVERY", 1.0)
    heard: dict[str, list[tuple[float, int]]] = {robot: [] for robot in ROBOTS}

    def listen(robot: str, message: Message) -> None:
        heard[robot].append((time.monotonic(), message.revision))

    def pauses(robot: str, revision: int) -> list[float]:
        times = [at for at, number in heard[robot] if number == revision]
        return [later - earlier for earlier, later in pairwise(times)]

    def is_quiet(robot: str, revision: int) -> bool:
        """Return whether reports came often at first, and then seldom."""
        found = pauses(robot, revision)
        return len(found) > 3 and min(found[:3]) < 0.5 < max(found[3:])

    async with (
        Core(port=0) as core,
        Node("move_clients", argv=[], master_uri=core.uri) as node,
        Node("planner", argv=[], master_uri=core.uri) as planner,
        asyncio.timeout(PATIENCE),
    ):
        running = asyncio.create_task(MoveClients(node, ROBOTS).run())
        grid = await planner.advertise("/fleet/map", "nav_msgs/OccupancyGrid", latch=True)
        grid.publish(grid_fields(GRID, (), planner.now()))
        cells = await planner.advertise("/Robot3/goalNodesList", "std_msgs/Int32MultiArray")
        for robot in ROBOTS:
            topic = f"/{robot}/moveClient/status"
            await planner.subscribe(topic, "fleet/MoveStatus", partial(listen, robot))
        while not cells.connections or not all(is_quiet(robot, 0) for robot in ROBOTS):
            await asyncio.sleep(0.05)
        cells.publish(numbered_array((), 7))
        while not is_quiet("Robot3", 7):
            await asyncio.sleep(0.05)
        node.shutdown("the test is over")
        await running
