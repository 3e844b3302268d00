"""Planner and move client as processes: a robot that turns slowly drives a longer path with fewer turns."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack

import pytest
from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import TypeRegistry

ZIGZAG = [0, 1, 7, 8, 14, 15, 21, 22, 28]
"""Cells of 6 x 6: 8 moves, seven turns."""
AROUND = [0, 6, 12, 18, 24, 30, 31, 32, 33, 34, 28]
"""10 moves, three turns."""


@pytest.mark.parametrize(
    ("options", "expected"), [((), ZIGZAG), (("_quarter_turn:=1", "_stop:=0.5"), AROUND)]
)
async def test_path_follows_from_the_cost_of_turns(options: tuple[str, ...], expected: list[int]) -> None:
    walls = sorted(set(range(36)) - {*ZIGZAG, *AROUND})
    floor = ("_rows:=6", "_columns:=6", f"_walls:={walls}")
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", *floor, *options))
        await stack.enter_async_context(fleet_program(core, "move_client.py", "__ns:=Robot1"))
        types = TypeRegistry(PACKAGES)
        node = await stack.enter_async_context(
            Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        )
        robot = RestingRobot(node, drives=True)
        await robot.start((0.5, 0.5))
        await robot.beat(STATUS)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(robot.keep_beating())
        stack.callback(beating.cancel)
        await robot.until("idle", 0)
        answer = await node.service_client("/fleet/set_goal", "fleet/SetGoal").call(
            {"robot": "Robot1", "cell": 28}
        )
        assert answer.ok
        await robot.until("arrived", 28)
    cells = [int(y) * 6 + int(x) for x, y in robot.places]
    assert set(cells) <= set(expected)
    assert len(set(cells)) > 3  # the ends of straight parts
