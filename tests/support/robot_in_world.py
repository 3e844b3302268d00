"""A robot in a world without physics, as a ROS node: lidar, odometry, frames, the map, wheels."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import inf, pi
from typing import TYPE_CHECKING

import numpy as np

from rce.ros.node import Node
from rce.ros.tf import StampedTransform, Transform
from rce.ros.types import Time
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.nodes.planar import pose_fields, read_twist, twist_fields
from rce_fleet.simulation.lidar import LidarSpec
from support.flat_world import Rectangle, World

if TYPE_CHECKING:
    from rce.ros.types import Message

STEP = 0.02
MOST_AT_ONCE = 0.1
"""Seconds that pass at once at most: a machine that is late must not drive the robot without its commands."""
SENSE_EVERY = 0.1
BEAMS = 180
EDGE = 0.1


def room(width: float, height: float, *more: Rectangle) -> list[Rectangle]:
    """Return the walls of a room, and more rectangles."""
    return [
        (0.0, 0.0, width, EDGE),
        (0.0, height - EDGE, width, height),
        (0.0, 0.0, EDGE, height),
        (width - EDGE, 0.0, width, height),
        *more,
    ]


class RobotInWorld:
    """Publishes what the robot senses, and drives it as commanded.

    Attributes:
        world: The world.
        commands: The commands that came, with their times in the world.
        senses: Whether scans are published.
        is_localized: Whether the odometry's place in the map is published.
        map_from_odom: The odometry's frame in the map.
        lidar_clock: How far the lidar's clock is ahead, seconds.
    """

    def __init__(self, node: Node, walls: list[Rectangle], boxes: list[Rectangle], at: Pose) -> None:
        self.node = node
        rng = np.random.default_rng(1)
        size = (max(one[2] for one in walls), max(one[3] for one in walls))
        self.world = World(walls, boxes, at, rng, lidar=LidarSpec(BEAMS, 6.0), size=size)
        self.commands: list[tuple[float, Twist]] = []
        self.senses = True
        self.is_localized = True
        self.map_from_odom = Pose(0.4, -0.3, 0.2)
        self.lidar_clock = 0.0

    async def run(self) -> None:
        """Let time pass until cancelled."""
        node, world = self.node, self.world
        map_topic = await node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        tf = await node.advertise("/tf", "tf2_msgs/TFMessage")
        odom = await node.advertise("odom", "nav_msgs/Odometry")
        scan = await node.advertise("scan", "sensor_msgs/LaserScan")
        await node.subscribe("cmd_vel", "geometry_msgs/Twist", self._take)
        picture = world.map()
        map_topic.publish(
            header={"stamp": node.now(), "frame_id": "map"},
            info={
                "resolution": picture.resolution,
                "width": picture.columns,
                "height": picture.rows,
                "origin": pose_fields(picture.origin),
            },
            data=picture.data.reshape(-1).tolist(),
        )
        loop = asyncio.get_running_loop()
        last, due, sensed = loop.time(), 0.0, -inf
        while True:
            now = loop.time()
            due += min(now - last, MOST_AT_ONCE)
            last = now
            while world.time < due:
                world.step(STEP)
            stamp = node.now()
            odom_from_base = self.map_from_odom.inverse().compose(world.pose)
            edges = (
                ("map", "odom", self.map_from_odom),
                ("odom", "base_link", odom_from_base),
                ("base_link", "base_scan", Pose(0.0, 0.0, 0.0)),
            )
            tf.publish(
                transforms=[
                    StampedTransform(parent, child, Transform.make(at.x, at.y, yaw=at.yaw), stamp).fields
                    for parent, child, at in edges
                    if self.is_localized or parent != "map"
                ]
            )
            odom.publish(
                header={"stamp": stamp, "frame_id": "odom"},
                child_frame_id="base_link",
                pose={"pose": pose_fields(odom_from_base)},
                twist={"twist": twist_fields(world.twist)},
            )
            if self.senses and world.time - sensed >= SENSE_EVERY:
                sensed = world.time
                scan.publish(
                    header={
                        "stamp": Time.from_sec(stamp.to_sec() + self.lidar_clock),
                        "frame_id": "base_scan",
                    },
                    angle_min=-pi,
                    angle_max=pi - 2 * pi / BEAMS,
                    angle_increment=2 * pi / BEAMS,
                    range_min=0.05,
                    range_max=6.0,
                    ranges=world.scan().tolist(),
                )
            await asyncio.sleep(STEP)

    def _take(self, message: Message) -> None:
        twist = read_twist(message)
        self.commands.append((self.world.time, twist))
        self.world.drive(twist)


@asynccontextmanager
async def robot_in_world(
    node: Node, walls: list[Rectangle], boxes: list[Rectangle], at: Pose
) -> AsyncIterator[RobotInWorld]:
    """Run a robot beside a test."""
    robot = RobotInWorld(node, walls, boxes, at)
    task = asyncio.create_task(robot.run())
    try:
        yield robot
    finally:
        task.cancel()
        await asyncio.wait((task,))
