"""A simulated robot as a ROS node: publishes sensors, accepts ``move_base`` goals.

Topics, relative to the node's namespace: publishes ``amcl_pose``, ``odom``, ``scan``, ``blockedCells``,
``move_base/status`` and ``move_base/result``; subscribes to ``move_base/goal`` and ``move_base/cancel``. On
``/tf`` it publishes the frames ``odom``, ``base_link`` and ``base_scan`` below ``map``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.tf import StampedTransform, Transform, frames
from rce.ros.tf.broadcaster import KIND, TF
from rce.ros.types import Time
from rce_fleet.geometry.angles import quaternion_z
from rce_fleet.simulation.move_base import SimulatedMoveBase
from rce_fleet.simulation.obstacles import hit_points

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce.ros.types import Message
    from rce_fleet.geometry.poses import Pose
    from rce_fleet.navigation.navigation import DriveLimits
    from rce_fleet.simulation.lidar import Floats
    from rce_fleet.simulation.move_base import Goal
    from rce_fleet.simulation.world import World

SENSE_EVERY = 0.1
"""Seconds between two poses, and between two scans."""
STATUS_EVERY = 0.2
"""Seconds between two status lists."""
RANGE_MIN = 0.05
"""Smallest range that the lidar reports, metres."""


@dataclass(slots=True)
class _Topics:
    """The node's publishers."""

    pose: Publisher
    odometry: Publisher
    scan: Publisher
    blocked: Publisher
    status: Publisher
    result: Publisher
    frames: Publisher


class RobotDriver:
    """Runs one robot of a world as a node.

    The caller calls :meth:`update` after every step of the world, about 20 times a second.

    Args:
        node: Running node; its namespace is the robot's.
        world: The world.
        robot: Id of the robot in the world.
        limits: Speeds and accelerations of the robot.
        tf_prefix: Prefix of the robot's frames, if several robots share a graph.
    """

    def __init__(
        self,
        node: Node,
        world: World,
        robot: str,
        limits: DriveLimits | None = None,
        *,
        tf_prefix: str = "",
    ) -> None:
        self._node = node
        self._world = world
        self._robot = world.robots[robot]
        self._base = SimulatedMoveBase(world.grid, self._robot.radius, limits)
        self._odom, self._base_link, self._base_scan = (
            frames.resolve(tf_prefix, frame) for frame in ("odom", "base_link", "base_scan")
        )
        self._points: Floats = np.empty((0, 2))
        self._topics: _Topics | None = None
        self._sensed_at = -math.inf
        self._listed_at = -math.inf

    async def start(self) -> None:
        """Create publishers and subscribers. They end with the node."""
        node = self._node
        self._topics = _Topics(
            pose=await node.advertise("amcl_pose", "geometry_msgs/PoseWithCovarianceStamped"),
            odometry=await node.advertise("odom", "nav_msgs/Odometry"),
            scan=await node.advertise("scan", "sensor_msgs/LaserScan"),
            blocked=await node.advertise("blockedCells", "std_msgs/Int32MultiArray"),
            status=await node.advertise("move_base/status", "actionlib_msgs/GoalStatusArray"),
            result=await node.advertise("move_base/result", "move_base_msgs/MoveBaseActionResult"),
            frames=await node.advertise(TF, KIND),
        )
        await node.subscribe("move_base/goal", "move_base_msgs/MoveBaseActionGoal", self._take_goal)
        await node.subscribe("move_base/cancel", "actionlib_msgs/GoalID", self._take_cancel)

    def update(self) -> None:
        """Publish sensors and drive; call it after a step of the world."""
        if self._topics is None:
            return
        now, stamp = self._world.time, Time.now()
        if now - self._sensed_at >= SENSE_EVERY - 1e-6:
            self._sensed_at = now
            self._sense(self._topics, stamp)
        found = self._base.blocked
        self._robot.drive(self._base.update(now, self._robot.estimate, self._points))
        for goal in self._base.take_ended():
            self._topics.result.publish(header={"stamp": stamp}, status=_status_of(goal), result={})
        fresh = self._base.blocked != found
        if fresh or now - self._listed_at >= STATUS_EVERY - 1e-6:
            self._listed_at = now
            self._list(self._topics, stamp)

    # What comes in

    def _take_goal(self, message: Message) -> None:
        place = message.goal.target_pose.pose.position
        goal_id = message.goal_id
        self._base.accept(goal_id.id, goal_id.stamp.to_sec(), place.x, place.y)

    def _take_cancel(self, message: Message) -> None:
        self._base.cancel(message.id, message.stamp.to_sec())

    # What goes out

    def _sense(self, topics: _Topics, stamp: Time) -> None:
        robot, spec = self._robot, self._robot.model.lidar
        ranges = self._world.scan(robot.id)
        self._points = hit_points(spec, ranges, robot.estimate)
        topics.pose.publish(
            header={"stamp": stamp, "frame_id": "map"},
            pose={"pose": _pose_fields(robot.estimate), "covariance": _covariance(robot.covariance)},
        )
        if topics.frames.connections:
            topics.frames.publish(transforms=[edge.fields for edge in self._tree(stamp)])
        twist = robot.twist
        topics.odometry.publish(
            header={"stamp": stamp, "frame_id": self._odom},
            child_frame_id=self._base_link,
            pose={"pose": _pose_fields(robot.odometry)},
            twist={"twist": {"linear": {"x": twist.speed}, "angular": {"z": twist.turn_rate}}},
        )
        if topics.scan.connections:
            topics.scan.publish(
                header={"stamp": stamp, "frame_id": self._base_scan},
                angle_min=-math.pi,
                angle_max=math.pi - spec.increment,
                angle_increment=spec.increment,
                scan_time=SENSE_EVERY,
                range_min=RANGE_MIN,
                range_max=spec.max_range,
                ranges=np.where(ranges < spec.max_range, ranges, math.inf).tolist(),
            )

    def _tree(self, stamp: Time) -> list[StampedTransform]:
        """Return the robot's frames, from the map down; the lidar is in the robot's middle."""
        map_from_base, odom_from_base = map(_transform, (self._robot.estimate, self._robot.odometry))
        map_from_odom = map_from_base @ odom_from_base.inverse()
        return [
            StampedTransform("map", self._odom, map_from_odom, stamp),
            StampedTransform(self._odom, self._base_link, odom_from_base, stamp),
            StampedTransform(self._base_link, self._base_scan, Transform(), stamp),
        ]

    def _list(self, topics: _Topics, stamp: Time) -> None:
        """Publish the status list, and the cells found blocked while they stop the robot."""
        if self._base.blocked:
            topics.blocked.publish(data=list(self._base.blocked))
        topics.status.publish(
            header={"stamp": stamp}, status_list=[_status_of(goal) for goal in self._base.goals]
        )


def _transform(pose: Pose) -> Transform:
    return Transform.make(pose.x, pose.y, yaw=pose.yaw)


def _pose_fields(pose: Pose) -> dict[str, Any]:
    z, w = quaternion_z(pose.yaw)
    return {"position": {"x": pose.x, "y": pose.y}, "orientation": {"z": z, "w": w}}


def _covariance(variances: tuple[float, float, float]) -> list[float]:
    """Return the 6 x 6 matrix of ``geometry_msgs/PoseWithCovariance`` with x, y and yaw set."""
    matrix = np.zeros((6, 6))
    matrix[[0, 1, 5], [0, 1, 5]] = variances
    return [float(value) for value in matrix.reshape(-1)]


def _status_of(goal: Goal) -> dict[str, Any]:
    return {
        "goal_id": {"stamp": Time.from_sec(goal.stamp), "id": goal.id},
        "status": goal.state.value,
        "text": goal.state.name.lower(),
    }
