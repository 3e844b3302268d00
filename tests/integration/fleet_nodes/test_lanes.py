"""The planner node on a lane graph: a robot drives the lanes in their direction, with their speed."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry
from rce_fleet.nodes.fleet_planner import BAD_PARAMETERS

if TYPE_CHECKING:
    from pathlib import Path

RING = [0, 1, 2, 5, 8, 7, 6, 3, 0]
LANES = """
nodes:
  corner: {x: 2.5, y: 0.5}
lanes:
  - {name: ring, path: [0, corner, 8, 6, 0], one_way: true, speed: 0.3, width: 0.5}
  - {name: gap, path: [3, 5], width: 0.4}
"""
GRID = ("_rows:=3", "_columns:=3")


async def test_a_one_way_lane_is_driven_in_its_direction(tmp_path: Path) -> None:
    """The goal is the cell behind the robot: it drives all around."""
    file = tmp_path / "lanes.yaml"
    file.write_text(LANES)
    limited = asyncio.Event()

    def take_speed(message: Message) -> None:
        if message.data == 0.3:
            limited.set()

    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", *GRID, f"_lanes:={file}"))
        await stack.enter_async_context(fleet_program(core, "move_client.py", "__ns:=Robot1"))
        node = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=TypeRegistry(PACKAGES))
        robot = RestingRobot(await stack.enter_async_context(node), drives=True)
        await node.subscribe("speed_limit", "std_msgs/Float64", take_speed)
        await robot.start((1.5, 0.5))
        await robot.beat(STATUS)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(robot.keep_beating())
        stack.callback(beating.cancel)
        await robot.until("idle", 1)

        set_goal = node.service_client("/fleet/set_goal", "fleet/SetGoal")
        assert (await set_goal(robot="Robot1", cell=4)).message == "cell 4 is on no lane; choose another goal"
        assert (await set_goal(robot="Robot1", cell=0)).ok
        await robot.until("arrived", 0)
        places = [RING.index(int(y) * 3 + int(x), 1) for x, y in robot.places]
        assert places == sorted(places), f"it drove back: {robot.places}"
        assert set(places) >= {RING.index(cell, 1) for cell in (1, 2, 8, 6, 0)}, "all corners"
        async with asyncio.timeout(50):
            await limited.wait()

        assert robot.newest is not None
        lanes = robot.newest.lanes
        assert [(lane.name, list(lane.cells), lane.one_way, lane.width) for lane in lanes] == [
            ("ring", RING, True, 0.5)
        ], "the other one is too narrow"
        set_grid = node.service_client("/fleet/set_grid", "fleet/SetGrid")
        refused = await set_grid(cell_size=1.5, origin_x=0.0, origin_y=0.0, blocked_share=-1.0)
        assert not refused.ok
        assert "change the file of lanes" in refused.message


async def test_a_planner_with_bad_lanes_ends(tmp_path: Path) -> None:
    file = tmp_path / "lanes.yaml"
    file.write_text("lanes: [{path: [0, 4]}]")
    async with (
        Core(port=0) as core,
        fleet_program(core, "fleet_planner.py", *GRID, f"_lanes:={file}") as planner,
    ):
        async with asyncio.timeout(50):
            assert await planner.wait() == BAD_PARAMETERS
