"""Planner and move client as processes, with a robot whose localization publishes one pose and then rests."""

from __future__ import annotations

import asyncio
import os
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.geometry.angles import quaternion_z

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce.ros.node import Publisher

PACKAGES = PackageIndex.from_environ()
STATUS = "move_base/status"
TYPES = {STATUS: "actionlib_msgs/GoalStatusArray", "odom": "nav_msgs/Odometry"}


@asynccontextmanager
async def program(core: Core, exe: str, *arguments: str) -> AsyncIterator[None]:
    """A node of the package ``fleet``."""
    command = [*PACKAGES.find("fleet").executable(exe), *arguments]
    process = await asyncio.create_subprocess_exec(*command, env={**os.environ, "ROS_MASTER_URI": core.uri})
    try:
        yield
    finally:
        process.terminate()
        await process.wait()


class RestingRobot:
    """A robot that stands: one latched pose, and messages at 5 Hz on some topics."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._beating: dict[str, Publisher] = {}
        self._state, self._reason = "", ""
        self._changed = asyncio.Event()

    async def start(self, cell_centre: tuple[float, float]) -> None:
        poses = await self._node.advertise("amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", latch=True)
        z, w = quaternion_z(0.5)
        position = {"x": cell_centre[0], "y": cell_centre[1]}
        poses.publish(
            header={"frame_id": "map"}, pose={"pose": {"position": position, "orientation": {"z": z, "w": w}}}
        )
        await self._node.subscribe("/fleet/state", "fleet/FleetState", self._take_state)

    async def beat(self, topic: str, kind: str) -> None:
        self._beating[topic] = await self._node.advertise(topic, kind)

    def rest(self, topic: str) -> None:
        """Publish no more on a topic."""
        del self._beating[topic]

    async def keep_beating(self) -> None:
        while await self._node.sleep(0.2):
            for publisher in self._beating.values():
                publisher.publish()

    async def until(self, state: str, timeout: float = 50.0) -> str:
        """Wait until the robot's state is this one; return its reason."""
        async with asyncio.timeout(timeout):
            while self._state != state:
                self._changed.clear()
                await self._changed.wait()
        return self._reason

    def _take_state(self, message: Message) -> None:
        for robot in message.robots:
            self._state, self._reason = robot.state, robot.reason
        self._changed.set()


@pytest.mark.parametrize(("alive_topic", "answers"), [(STATUS, False), (STATUS, True), ("odom", False)])
async def test_a_robot_at_rest_lives_and_a_dead_one_is_silent(alive_topic: str, answers: bool) -> None:
    """The planner takes a standing robot for there by the states of its goals, or by another topic."""
    options = ["_answers:=true"] if answers else []
    client = [*options, "__ns:=Robot1"] + ([f"_alive_topic:={alive_topic}"] if alive_topic != STATUS else [])
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(program(core, "fleet_planner.py", *options))
        await stack.enter_async_context(program(core, "move_client.py", *client))
        types = TypeRegistry(PACKAGES)
        node = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        robot = RestingRobot(await stack.enter_async_context(node))
        await robot.start((2.5, 3.5))
        for topic in {STATUS, alive_topic}:
            await robot.beat(topic, TYPES[topic])
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(robot.keep_beating())
        stack.callback(beating.cancel)
        await robot.until("idle")
        await asyncio.sleep(FleetSettings().silence_timeout + 1.5)
        await robot.until("idle")  # No pose has come since, so this would not be again.
        robot.rest(alive_topic)
        assert "neither poses nor states" in await robot.until("silent")
        await robot.beat(alive_topic, TYPES[alive_topic])
        await robot.until("idle")
