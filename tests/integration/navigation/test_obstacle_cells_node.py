"""``obstacle_cells`` on a real core: a box is reported, and reported free when it is gone; walls are not."""

from __future__ import annotations

import asyncio

import pytest
from support.flat_world import edges_of
from support.robot_in_world import robot_in_world, room

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message
from rce_fleet.geometry.poses import Pose
from rce_fleet.nodes.map_messages import map_fields
from rce_fleet.nodes.obstacle_cells import ObstacleCellsNode, ObstacleCellsParameters
from rce_fleet.nodes.planar import pose_fields

pytestmark = pytest.mark.timeout(240)

WALLS = room(4.0, 3.0)
BOX = (2.2, 1.2, 2.8, 1.8)


async def test_a_box_is_reported_and_reported_free() -> None:
    async with (
        Core(port=0) as core,
        Node("robot", namespace="Robot1", argv=[], master_uri=core.uri) as robot_node,
        Node("obstacle_cells", namespace="Robot1", argv=["map:=late_map"], master_uri=core.uri) as node,
        Node("judge", argv=[], master_uri=core.uri) as judge,
        robot_in_world(robot_node, WALLS, [BOX], Pose(0.6, 1.5, 0.0)) as robot,
    ):
        fleet = await judge.advertise("/fleet/map", "nav_msgs/OccupancyGrid", latch=True)
        fleet.publish(
            info={"resolution": 1.0, "width": 4, "height": 3, "origin": pose_fields(Pose(0.0, 0.0, 0.0))},
            data=[0] * 12,
        )
        blocked: asyncio.Queue[Message] = asyncio.Queue()
        freed: asyncio.Queue[Message] = asyncio.Queue()
        await judge.subscribe("/Robot1/blockedCells", "std_msgs/Int32MultiArray", blocked.put_nowait)
        await judge.subscribe("/Robot1/freedCells", "std_msgs/Int32MultiArray", freed.put_nowait)
        states: asyncio.Queue[str] = asyncio.Queue()

        def take_states(message: Message) -> None:
            for status in message.status:
                states.put_nowait(status.message)

        await judge.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", take_states)
        task = asyncio.create_task(ObstacleCellsNode(node, ObstacleCellsParameters()).run())
        try:
            for _ in range(3):  # a second each, in which scans of walls come
                async with asyncio.timeout(60):
                    while await states.get() != "waiting for the map on /Robot1/late_map":
                        pass
            assert blocked.empty()
            drawn = await judge.advertise("/Robot1/late_map", "nav_msgs/OccupancyGrid", latch=True)
            drawn.publish(**map_fields(robot.world.map(), "map", judge.now()))
            assert list((await asyncio.wait_for(blocked.get(), 60)).data) == [6]
            robot.world.boxes.clear()
            robot.world.edges = edges_of(WALLS)
            assert list((await asyncio.wait_for(freed.get(), 60)).data) == [6]
        finally:
            task.cancel()
            await asyncio.wait((task,))
