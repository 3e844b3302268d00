"""The safety stage as a node on a real core, with messages that a test makes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import inf, pi
from typing import Any

import numpy as np
import pytest

from rce.ros.core import Core
from rce.ros.node import Node, Publisher
from rce.ros.tf import StampedTransform, Transform
from rce.ros.types import Message
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.nodes.planar import pose_fields, read_twist, twist_fields
from rce_fleet.nodes.velocity_limiter import VelocityLimiterNode

pytestmark = pytest.mark.timeout(120)

BEAMS = 360
EVERY = 0.05
AHEAD = Twist(0.3, 0.0)


class Senses:
    """Publishes odometry, a scan and a command again and again.

    Attributes:
        odometry: Pose of the robot.
        ranges: Of the scan, in the lidar's frame, from -pi on.
        command: To be limited.
        passed: What the stage let pass.
    """

    def __init__(self, node: Node, mounted: Transform) -> None:
        self._node = node
        self._mounted = mounted
        self.odometry = Pose(0.0, 0.0, 0.0)
        self.ranges = np.full(BEAMS, inf)
        self.command = AHEAD
        self.passed: asyncio.Queue[Twist] = asyncio.Queue()

    async def run(self) -> None:
        """Publish until cancelled."""
        node = self._node
        kinds: dict[str, str] = {
            "odom": "nav_msgs/Odometry", "scan": "sensor_msgs/LaserScan", "raw_cmd_vel": "geometry_msgs/Twist"
        }  # fmt: skip
        out: dict[str, Publisher] = {name: await node.advertise(name, kind) for name, kind in kinds.items()}
        frames = await node.advertise("/tf_static", "tf2_msgs/TFMessage", latch=True)
        edge = StampedTransform("base_link", "laser", self._mounted, node.now())
        frames.publish(transforms=[edge.fields])
        await node.subscribe("cmd_vel", "geometry_msgs/Twist", self._take)
        while True:
            header: dict[str, Any] = {"stamp": node.now(), "frame_id": "laser"}
            out["odom"].publish(header=header, pose={"pose": pose_fields(self.odometry)})
            out["scan"].publish(
                header=header, angle_min=-pi, angle_max=pi - 2 * pi / BEAMS, angle_increment=2 * pi / BEAMS,
                range_min=0.05, range_max=6.0, ranges=self.ranges.tolist(),
            )  # fmt: skip
            out["raw_cmd_vel"].publish(**twist_fields(self.command))
            await asyncio.sleep(EVERY)

    def _take(self, message: Message) -> None:
        self.passed.put_nowait(read_twist(message))

    async def next_passed(self, command: Twist) -> Twist:
        """Give a command, and return what passes of it after a while."""
        self.command = command
        for _ in range(10):  # more than the commands and scans that are on their way
            await asyncio.wait_for(self.passed.get(), 30)
        while not self.passed.empty():
            self.passed.get_nowait()
        return await asyncio.wait_for(self.passed.get(), 30)


@asynccontextmanager
async def stage(mounted: Transform) -> AsyncIterator[Senses]:
    """Run the safety stage of a robot whose lidar is mounted in some way."""
    async with (
        Core(port=0) as core,
        Node("velocity_limiter", argv=[], master_uri=core.uri) as node,
        Node("robot", argv=[], master_uri=core.uri) as robot,
    ):
        senses = Senses(robot, mounted)
        parameters = SafetyParameters(
            robot_radius=0.2, walking_speed=0.0, scan_timeout=5.0, command_timeout=5.0, transform_timeout=5.0
        )
        tasks = [asyncio.create_task(one.run()) for one in (senses, VelocityLimiterNode(node, parameters))]
        try:
            async with asyncio.timeout(60):
                while await senses.passed.get() != AHEAD:
                    pass
            yield senses
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)


async def test_a_lidar_upside_down_sees_the_right_side() -> None:
    """The box is to the left of the robot; the lidar, which hangs upside down, sees it to its right."""
    async with stage(Transform.make(roll=pi)) as senses:
        angles = -pi + np.arange(BEAMS) * 2 * pi / BEAMS
        senses.ranges = np.where(np.abs(angles + 0.9) < 0.25, 0.35, inf)
        to_the_left = await senses.next_passed(Twist(0.6, 2.8))
        assert to_the_left.speed < 0.5
        assert await senses.next_passed(Twist(0.6, -2.8)) == Twist(0.6, -2.8)
