"""The safety stage as a node on a real core, with messages that a test makes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
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
PARAMETERS = SafetyParameters(
    robot_radius=0.2, walking_speed=0.0, scan_timeout=5.0, command_timeout=5.0, transform_timeout=5.0
)


class Senses:
    """Publishes odometry, a scan and a command again and again.

    Attributes:
        odometry: Pose of the robot.
        ranges: Of the scan, in the lidar's frame, from -pi on.
        scans: Whether scans are published; without them the stamp of the last one is kept.
        command: To be limited.
        passed: What the stage let pass.
        stage: The task of the stage.
    """

    stage: asyncio.Task[None]

    def __init__(self, node: Node, mounted: Transform) -> None:
        self.node = node
        self._mounted = mounted
        self.odometry = Pose(0.0, 0.0, 0.0)
        self.ranges = np.full(BEAMS, inf)
        self.scans = True
        self.command = AHEAD
        self.passed: asyncio.Queue[Twist] = asyncio.Queue()

    async def run(self) -> None:
        """Publish until cancelled."""
        node = self.node
        kinds: dict[str, str] = {
            "odom": "nav_msgs/Odometry", "scan": "sensor_msgs/LaserScan", "raw_cmd_vel": "geometry_msgs/Twist"
        }  # fmt: skip
        out: dict[str, Publisher] = {name: await node.advertise(name, kind) for name, kind in kinds.items()}
        frames = await node.advertise("/tf_static", "tf2_msgs/TFMessage", latch=True)
        edge = StampedTransform("base_link", "laser", self._mounted, node.now())
        frames.publish(transforms=[edge.fields])
        await node.subscribe("cmd_vel", "geometry_msgs/Twist", self._take)
        stamp = node.now()
        while True:
            stamp = node.now() if self.scans else stamp
            header: dict[str, Any] = {"stamp": stamp, "frame_id": "laser"}
            out["odom"].publish(header=header, pose={"pose": pose_fields(self.odometry)})
            if self.scans:
                out["scan"].publish(
                    header=header, angle_min=-pi, angle_max=pi - 2 * pi / BEAMS,
                    angle_increment=2 * pi / BEAMS, range_min=0.05, range_max=6.0,
                    ranges=self.ranges.tolist(),
                )  # fmt: skip
            out["raw_cmd_vel"].publish(**twist_fields(self.command))
            await asyncio.sleep(EVERY)

    def _take(self, message: Message) -> None:
        self.passed.put_nowait(read_twist(message))

    async def wait_for(self, is_right: Callable[[Twist], bool]) -> None:
        """Wait until what passes is as expected."""
        async with asyncio.timeout(30):
            while not is_right(await self.passed.get()):
                pass


@asynccontextmanager
async def stage(
    mounted: Transform, parameters: SafetyParameters = PARAMETERS, first: Twist = AHEAD
) -> AsyncIterator[Senses]:
    """Run the safety stage of a robot whose lidar is mounted in some way, until ``first`` passes."""
    async with (
        Core(port=0) as core,
        Node("velocity_limiter", argv=[], master_uri=core.uri) as node,
        Node("robot", argv=[], master_uri=core.uri) as robot,
    ):
        senses = Senses(robot, mounted)
        senses.stage = asyncio.create_task(VelocityLimiterNode(node, parameters).run())
        tasks = [asyncio.create_task(senses.run()), senses.stage]
        try:
            await senses.wait_for(lambda twist: twist == first)
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
        senses.command = Twist(0.6, 2.8)
        await senses.wait_for(lambda twist: twist.turn_rate > 0 and twist.speed < 0.5)
        senses.command = Twist(0.6, -2.8)
        await senses.wait_for(lambda twist: twist == Twist(0.6, -2.8))


async def test_odometry_that_turns_at_once_forgets_the_scan() -> None:
    """The box is ahead; a compass that is set anew turns the odometry, but not the robot."""
    async with stage(Transform()) as senses:
        angles = -pi + np.arange(BEAMS) * 2 * pi / BEAMS
        senses.ranges = np.where(np.abs(angles) < 0.3, 0.25, inf)
        senses.command = Twist(0.6, 0.0)
        await senses.wait_for(lambda twist: 0.0 < twist.speed < 0.2)
        senses.scans, senses.odometry = False, Pose(0.0, 0.0, pi)
        for _ in range(20):
            assert (await asyncio.wait_for(senses.passed.get(), 30)).speed < 0.2


async def test_late_velocities_of_an_operator_are_stops() -> None:
    """The stage answers the station's clock; while its times come later and later, the robot stands."""
    async with stage(Transform()) as senses:
        answers: list[float] = []
        clock = await senses.node.advertise("drive_clock", "std_msgs/Float64")
        await senses.node.subscribe("drive_echo", "std_msgs/Float64", lambda said: answers.append(said.data))

        async def come_late() -> None:
            for number in range(1_000_000):
                clock.publish(data=1000.0 + 0.01 * number)
                await asyncio.sleep(EVERY)

        sending = asyncio.create_task(come_late())
        try:
            await senses.wait_for(lambda twist: twist == Twist())
            async with asyncio.timeout(30):
                while not answers:
                    await asyncio.sleep(EVERY)
        finally:
            sending.cancel()
        assert 1000.0 <= answers[0] < 1100.0
        await senses.wait_for(lambda twist: twist == AHEAD)


async def test_a_stage_that_ends_early_stops_the_wheels() -> None:
    async with stage(Transform()) as senses:
        senses.stage.cancel()
        await asyncio.wait((senses.stage,))
        await senses.wait_for(lambda twist: twist == Twist())
        await asyncio.sleep(4 * EVERY)  # commands come as before
        while not senses.passed.empty():
            assert senses.passed.get_nowait() == Twist()


async def test_a_robot_of_unknown_outline_stands_and_says_why() -> None:
    """To take the default outline would let a larger robot hit what it passes."""
    wrong = replace(PARAMETERS, footprint="[[0.5, 0.3], [0.5")
    async with stage(Transform(), wrong, Twist()) as senses:
        states: asyncio.Queue[str] = asyncio.Queue()

        def take(message: Message) -> None:
            for status in message.status:
                states.put_nowait(status.message)

        await senses.node.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", take)
        async with asyncio.timeout(60):
            while "expected [[x, y], ...], found '[[0.5, 0.3], [0.5'" not in await states.get():
                pass
        while not senses.passed.empty():
            assert senses.passed.get_nowait() == Twist()


async def test_an_old_release_does_not_end_a_stop_by_service() -> None:
    """As the station's last message, which comes again when the robot's network is back."""
    async with stage(Transform()) as senses:
        node, stopped = senses.node, asyncio.Queue[bool]()
        await node.subscribe(
            "velocity_limiter/emergency_stopped", "std_msgs/Bool", lambda said: stopped.put_nowait(said.data)
        )
        topic = await node.advertise("emergency_stop", "std_msgs/Bool")
        await topic.wait_for_subscribers(timeout=60)
        service = node.service_client("velocity_limiter/set_emergency_stop", "std_srvs/SetBool")

        async def told(expected: bool) -> None:
            assert await asyncio.wait_for(stopped.get(), 60) is expected

        await told(False)
        assert (
            await service(data=True)
        ).message == "stopped: emergency stop by /velocity_limiter/set_emergency_stop"
        await told(True)
        await senses.wait_for(lambda twist: twist == Twist())
        topic.publish(data=False)
        await told(True)
        while not senses.passed.empty():
            assert senses.passed.get_nowait() == Twist()
        topic.publish(data=True)
        await told(True)
        answer = await service(data=False)
        assert (answer.success, answer.message) == (True, "stopped: emergency stop by /emergency_stop")
        await told(True)
        topic.publish(data=False)
        await told(False)
        await senses.wait_for(lambda twist: twist == AHEAD)
