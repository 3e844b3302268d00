"""A box on no map: ``obstacle_cells`` reports its cell to the planner, which plans anew."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import pytest
from support.flat_world import edges_of
from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program
from support.robot_in_world import robot_in_world, room

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry
from rce_fleet.geometry.poses import Pose

if TYPE_CHECKING:
    from collections.abc import Callable


pytestmark = pytest.mark.timeout(300)

WALLS = room(4.0, 3.0)
BOX = (2.2, 1.2, 2.8, 1.8)
BOX_CELL = 6
DIRECT = [4, 5, BOX_CELL, 7]
LIMIT_S = 100.0


async def test_a_box_on_no_map_causes_a_new_plan() -> None:
    """The robot that sees the box is sent around its cell, and straight on again when the box is gone."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "_rows:=3", "_columns:=4"))
        for exe in ("move_client.py", "obstacle_cells.py"):
            await stack.enter_async_context(fleet_program(core, exe, "__ns:=Robot1"))
        types = TypeRegistry(PACKAGES)
        node = await stack.enter_async_context(
            Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        )
        sensed = await stack.enter_async_context(robot_in_world(node, WALLS, [], Pose(0.5, 1.5, 0.0)))
        robot = RestingRobot(node)
        await robot.start((0.5, 1.5))
        await robot.beat(STATUS)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        stack.callback(tasks.create_task(robot.keep_beating()).cancel)
        await robot.until("idle", 4)
        set_goal = node.service_client("/fleet/set_goal", "fleet/SetGoal")
        assert (await set_goal(robot="Robot1", cell=7)).ok
        await shown(robot, lambda state: list(state.robots[0].plan) == DIRECT)

        sensed.world.boxes.append(BOX)
        sensed.world.edges = edges_of([*WALLS, BOX])
        around = await shown(robot, is_led_around)
        assert around.robots[0].replans >= 1

        sensed.world.boxes.clear()
        sensed.world.edges = edges_of(WALLS)
        await shown(
            robot, lambda state: BOX_CELL not in state.blocked and list(state.robots[0].plan) == DIRECT
        )


def is_led_around(state: Message) -> bool:
    """Return whether the cell is blocked, and the robot's way does not lead through it."""
    plan = state.robots[0].plan
    return BOX_CELL in state.blocked and len(plan) > 2 and BOX_CELL not in plan


async def shown(robot: RestingRobot, condition: Callable[[Message], bool]) -> Message:
    """Wait for a state of the planner."""
    try:
        async with asyncio.timeout(LIMIT_S):
            while robot.newest is None or not condition(robot.newest):
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise AssertionError(f"the planner's state is still {robot.newest}") from None
    return robot.newest
