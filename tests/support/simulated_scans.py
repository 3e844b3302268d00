"""A robot in a small hall: its odometry, transforms and scans, published step by step."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.tf import StaticTransformBroadcaster, Transform, TransformBroadcaster
from rce.ros.types import Time
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ray_casting import cast_rays

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from rce.ros.node import Node

BEAMS = 90
FARTHEST = 8.0
LASER = Pose(0.1, 0.0, pi)
"""The laser on the base: it looks backwards."""


def hall() -> OccupancyMap:
    """Return a hall without symmetry, 5 x 4 m."""
    data = np.zeros((80, 100), np.int8)
    data[0] = data[-1] = data[:, 0] = data[:, -1] = 100
    data[30:40, 0:35] = data[55:80, 60:66] = data[15:22, 70:85] = 100
    return OccupancyMap(data, 0.05)


class Robot:
    """Publishes ``/tf``, ``/tf_static`` and ``scan`` of a robot.

    Args:
        node: Publishes them.
        pose: Where the robot is in the hall.
    """

    def __init__(self, node: Node, pose: Pose) -> None:
        self.node = node
        self.pose = pose
        self.odometry = Pose(0.0, 0.0, 0.0)
        self.grid = hall()

    async def start(self, stack: AsyncExitStack) -> None:
        """Advertise everything, until the stack is closed."""
        self._tf = await stack.enter_async_context(TransformBroadcaster(self.node))
        self._static = await stack.enter_async_context(StaticTransformBroadcaster(self.node))
        self._scans = await self.node.advertise("scan", "sensor_msgs/LaserScan")
        self._static.send("base_link", "laser", Transform.make(LASER.x, LASER.y, yaw=LASER.yaw))

    def drive(self, way: float, turn: float) -> None:
        """Drive; the odometry says 3 % more."""
        self.pose = self.pose.compose(Pose(way, 0.0, turn))
        self.odometry = self.odometry.compose(Pose(1.03 * way, 0.0, turn))

    def publish(self, stamp: Time | None = None, *, transform: bool = True, **changed: Any) -> Time:
        """Publish transform and scan; ``changed`` are other values of the scan's fields. Return the stamp."""
        stamp = self.node.now() if stamp is None else stamp
        if transform:
            at = self.odometry
            self._tf.send("odom", "base_link", Transform.make(at.x, at.y, yaw=at.yaw), stamp)
        laser = self.pose.compose(LASER)
        angles = -pi + np.arange(BEAMS) * (2 * pi / BEAMS)
        ranges = cast_rays(self.grid, (laser.x, laser.y), angles + laser.yaw, FARTHEST)
        fields: dict[str, Any] = {
            "header": {"stamp": stamp, "frame_id": "laser"},
            "angle_min": -pi,
            "angle_max": pi - 2 * pi / BEAMS,
            "angle_increment": 2 * pi / BEAMS,
            "range_min": 0.1,
            "range_max": FARTHEST,
            "ranges": ranges,
        }
        self._scans.publish(**(fields | changed))
        return stamp
