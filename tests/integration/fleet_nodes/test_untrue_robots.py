"""A planner and robots that send what no robot sends: places beyond all maps, reports that mean nothing."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from math import nan
from typing import Any

import pytest
from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry
from rce_fleet.nodes.throttled_log import EVERY

POSE = "geometry_msgs/PoseWithCovarianceStamped"


class Fleet:
    """A planner with one good robot and its move client, and a node that says what it likes."""

    def __init__(self, liar: Node, good: RestingRobot) -> None:
        self.liar = liar
        self.good = good
        self.heard: asyncio.Queue[str] = asyncio.Queue()

    def take_log(self, message: Message) -> None:
        self.heard.put_nowait(message.msg)

    async def hears(self, text: str) -> None:
        async with asyncio.timeout(60):
            while text not in await self.heard.get():
                pass

    async def ask(self, cell: int) -> Message:
        client = self.liar.service_client("/fleet/set_goal", "fleet/SetGoal")
        async with asyncio.timeout(60):
            return await client(robot="Good", cell=cell)


@pytest.fixture
async def fleet() -> AsyncIterator[Fleet]:
    async with Core(port=0) as core, AsyncExitStack() as stack:
        types = TypeRegistry(PACKAGES)
        made = Node("liar", namespace="Liar", argv=[], master_uri=core.uri, types=types)
        liar = await stack.enter_async_context(made)
        made = Node("robot", namespace="Good", argv=[], master_uri=core.uri, types=types)
        node = await stack.enter_async_context(made)
        good = RestingRobot(node)
        fleet = Fleet(liar, good)
        await liar.subscribe("/rosout", "rosgraph_msgs/Log", fleet.take_log)
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "_cell_size:=0.8"))
        await stack.enter_async_context(fleet_program(core, "move_client.py", "__ns:=Good"))
        await good.start((1.2, 1.2))
        await good.beat(STATUS)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(good.keep_beating())
        stack.callback(beating.cancel)
        yield fleet


def pose_fields(x: float, y: float) -> dict[str, Any]:
    return {"pose": {"pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}}}


async def test_messages_that_no_robot_sends_disturb_no_other(fleet: Fleet) -> None:
    """Each is told of in words, without a traceback, and the other robot drives."""
    poses = await fleet.liar.advertise("amcl_pose", POSE, latch=True)
    reports = await fleet.liar.advertise("moveClient/status", "fleet/MoveStatus", latch=True)
    poses.publish(pose_fields(1.7e308, 1.0))
    await fleet.hears("poses of Liar are ignored: expected finite numbers")
    reports.publish(state="flying", revision=1)
    await fleet.hears("a report of the move client of Liar is ignored: its state must be one")
    cells = await fleet.liar.advertise("blockedCells", "std_msgs/Int32MultiArray", latch=True)
    cells.publish(data=[20, 21])
    await fleet.hears("cells that Liar reports blocked or free are ignored: it has sent no pose")
    poses.publish(pose_fields(nan, nan))
    poses.publish(pose_fields(5.0, 5.0))
    reports.publish(state="idle", revision=2**63 - 1)
    await fleet.hears("the number of its list must be within 0 .. 9007199254740992, not 9223372036854775807")
    await fleet.good.until("idle")
    answer = await fleet.ask(cell=9)
    assert answer.ok, answer.message
    await fleet.good.until("arrived", 9)


async def test_a_flood_of_lists_that_are_no_paths_is_told_of_once(fleet: Fleet) -> None:
    """Each warning would go to all who read the log. The robot drives as before."""
    await fleet.good.until("idle")
    lists = await fleet.liar.advertise("/Good/goalNodesList", "std_msgs/Int32MultiArray", latch=True)
    lists.publish(data=[0, 5])
    await fleet.hears("the list of cells was refused: [0, 5] is not a path on the map")
    began = asyncio.get_running_loop().time()
    for cell in range(1000):
        lists.publish(data=[cell % 64, (cell + 5) % 64])
    await fleet.ask(cell=9)
    await fleet.good.until("arrived", 9)
    took = asyncio.get_running_loop().time() - began
    said = [fleet.heard.get_nowait() for _ in range(fleet.heard.qsize())]
    assert sum("was refused" in text for text in said) <= 1 + took / EVERY
