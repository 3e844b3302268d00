"""Publishes the poses of all robots on one topic, so that a page need not subscribe to a topic of each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce_fleet.geometry.angles import yaw_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.node import Node, Publisher
    from rce.ros.types import Message
    from rce_fleet.coordination.robot import RobotRecord

POSES = "fleet/FleetPoses"
POSES_TOPIC = "/fleet/poses"
WHOLE_S = 2.0
"""Seconds between two messages with the poses of all robots, for programs that came later."""
_DIGITS = 4
"""Digits after the point: a tenth of a millimetre, and few bytes as JSON."""

Planar = tuple[float, float, float]
"""Metres, metres, radians."""


class PosePublisher:
    """Publishes ``/fleet/poses``.

    Args:
        node: Running node.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._poses: dict[str, Planar] = {}
        self._moved: set[str] = set()
        self._whole_at = float("-inf")
        self._publisher: Publisher

    async def start(self) -> None:
        """Advertise the topic."""
        self._publisher = await self._node.advertise(POSES_TOPIC, POSES)

    def take(self, robot: str, message: Message) -> None:
        """Note the pose of a ``geometry_msgs/PoseWithCovarianceStamped``."""
        pose = message.pose.pose
        turn = pose.orientation
        self._poses[robot] = pose.position.x, pose.position.y, yaw_of(turn.x, turn.y, turn.z, turn.w)
        self._moved.add(robot)

    def update(self, robots: Mapping[str, RobotRecord], now: float) -> None:
        """Publish what is due; call it some times a second.

        Args:
            robots: Robots of the fleet; poses of others are forgotten.
            now: The planner's time, seconds.
        """
        if now - self._whole_at >= WHOLE_S:
            self._whole_at = now
            self._poses = {robot: self._poses[robot] for robot in robots if robot in self._poses}
            self._publish(self._poses, robots, now)
        elif self._moved:
            moved = {robot: self._poses[robot] for robot in self._moved if robot in self._poses}
            self._publish({robot: pose for robot, pose in moved.items() if robot in robots}, robots, now)
        self._moved.clear()

    def _publish(self, poses: Mapping[str, Planar], robots: Mapping[str, RobotRecord], now: float) -> None:
        ages = [round(robots[robot].heartbeat_age(now), 1) for robot in poses]
        self._publisher.publish({**poses_fields(poses), "age": ages})


def poses_fields(poses: Mapping[str, Planar]) -> dict[str, Any]:
    """Return names and poses of a ``fleet/FleetPoses``."""
    columns = zip(*poses.values(), strict=True) if poses else ((), (), ())
    x, y, yaw = ([round(value, _DIGITS) for value in column] for column in columns)
    return {"robots": list(poses), "x": x, "y": y, "yaw": yaw}
