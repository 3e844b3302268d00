"""What stands for a robot's localization and ``move_base``, for fleets without the real ones.

Topics, relative to the node's namespace: publishes ``amcl_pose``, ``blockedCells``, ``move_base/status`` and
``move_base/result``; subscribes to ``move_base/goal``, ``move_base/cancel`` and ``speed_limit``. On ``/tf``
it publishes the frame ``odom`` below ``map``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.tf import StampedTransform
from rce.ros.types import Message, Time
from rce_fleet.drivers.fields import pose_fields, transform_of
from rce_fleet.geometry.poses import Twist
from rce_fleet.navigation.navigation import DriveLimits, read_speed_limit
from rce_fleet.simulation.move_base import SimulatedMoveBase
from rce_fleet.simulation.obstacles import hit_points

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.goal_list import Goal
    from rce_fleet.simulation.lidar import Floats
    from rce_fleet.simulation.robot import SimulatedRobot

STATUS_EVERY = 0.2
"""Seconds between two status lists."""


@dataclass(slots=True)
class _Topics:
    """The publishers."""

    pose: Publisher
    blocked: Publisher
    status: Publisher
    result: Publisher


class StandIn:
    """Localizes and drives one robot.

    Args:
        node: Running node; its namespace is the robot's.
        grid: The fleet's map.
        robot: The robot.
        limits: Speeds and accelerations to drive with; None: those that the robot's wheels allow.
    """

    def __init__(
        self, node: Node, grid: GridMap, robot: SimulatedRobot, limits: DriveLimits | None = None
    ) -> None:
        self._node = node
        self._robot = robot
        self._base = SimulatedMoveBase(grid, robot.radius, limits or _limits_of(robot))
        self._points: Floats = np.empty((0, 2))
        self._topics: _Topics | None = None
        self._listed_at = -math.inf
        self._drove = False

    async def start(self) -> None:
        """Create publishers and subscribers. They end with the node."""
        node = self._node
        self._topics = _Topics(
            pose=await node.advertise("amcl_pose", "geometry_msgs/PoseWithCovarianceStamped"),
            blocked=await node.advertise("blockedCells", "std_msgs/Int32MultiArray"),
            status=await node.advertise("move_base/status", "actionlib_msgs/GoalStatusArray"),
            result=await node.advertise("move_base/result", "move_base_msgs/MoveBaseActionResult"),
        )
        await node.subscribe("move_base/goal", "move_base_msgs/MoveBaseActionGoal", self._take_goal)
        await node.subscribe("move_base/cancel", "actionlib_msgs/GoalID", self._take_cancel)
        await node.subscribe("speed_limit", "std_msgs/Float64", self._take_speed_limit)

    def reset(self, now: float) -> None:
        """Forget when the last status list was: time begins anew at ``now``, seconds."""
        self._listed_at = now - STATUS_EVERY

    def sense(self, stamp: Time, ranges: Floats) -> None:
        """Take a scan, and publish the estimated pose."""
        robot = self._robot
        self._points = hit_points(robot.model.lidar, ranges, robot.estimate)
        if self._topics is not None:
            self._topics.pose.publish(
                header={"stamp": stamp, "frame_id": "map"},
                pose={"pose": pose_fields(robot.estimate), "covariance": _covariance(robot.covariance)},
            )

    def map_from_odom(self, odom: str, stamp: Time) -> StampedTransform:
        """Return the transform that the estimate corrects odometry with; ``odom`` is the frame's name."""
        map_from_base, odom_from_base = map(transform_of, (self._robot.estimate, self._robot.odometry))
        return StampedTransform("map", odom, map_from_base @ odom_from_base.inverse(), stamp)

    def update(self, now: float, stamp: Time) -> None:
        """Drive, and publish what became of goals."""
        if self._topics is None:
            return
        found = self._base.blocked
        twist = self._base.update(now, self._robot.estimate, self._points)
        drives = twist != Twist()
        if drives or self._drove:  # A robot without a goal is free for others' commands.
            self._robot.drive(twist)
        self._drove = drives
        for goal in self._base.take_ended():
            self._topics.result.publish(header={"stamp": stamp}, status=status_of(goal), result={})
        fresh = self._base.blocked != found
        if fresh or now - self._listed_at >= STATUS_EVERY - 1e-6:
            self._listed_at = now
            self._list(self._topics, stamp)

    def _take_goal(self, message: Message) -> None:
        place = message.goal.target_pose.pose.position
        goal_id = message.goal_id
        self._base.accept(goal_id.id, goal_id.stamp.to_sec(), place.x, place.y)

    def _take_cancel(self, message: Message) -> None:
        self._base.cancel(message.id, message.stamp.to_sec())

    def _take_speed_limit(self, message: Message) -> None:
        try:
            self._base.limit_speed(read_speed_limit(message.data))
        except ValueError as error:
            self._node.log.warning("%s", error)

    def _list(self, topics: _Topics, stamp: Time) -> None:
        """Publish the status list, and the cells found blocked while they stop the robot."""
        if self._base.blocked:
            topics.blocked.publish(data=list(self._base.blocked))
        topics.status.publish(
            header={"stamp": stamp}, status_list=[status_of(goal) for goal in self._base.goals]
        )


def _limits_of(robot: SimulatedRobot) -> DriveLimits:
    """Return limits within those of a robot's wheels."""
    usual, wheels = DriveLimits(), robot.model.drive
    return DriveLimits(
        speed=min(usual.speed, wheels.speed),
        acceleration=min(usual.acceleration, wheels.acceleration, wheels.deceleration),
        turn_rate=min(usual.turn_rate, wheels.turn_rate),
        turn_acceleration=min(usual.turn_acceleration, wheels.turn_acceleration),
    )


def _covariance(variances: tuple[float, float, float]) -> list[float]:
    """Return the 6 x 6 matrix of ``geometry_msgs/PoseWithCovariance`` with x, y and yaw set."""
    matrix = np.zeros((6, 6))
    matrix[[0, 1, 5], [0, 1, 5]] = variances
    return [float(value) for value in matrix.reshape(-1)]


def status_of(goal: Goal) -> dict[str, Any]:
    """Return the fields of an ``actionlib_msgs/GoalStatus``."""
    return {
        "goal_id": {"stamp": Time.from_sec(goal.stamp), "id": goal.id},
        "status": goal.state.value,
        "text": goal.fault or goal.state.name.lower(),
    }
