"""Reads what robots and their move clients send to the planner."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.events import PoseSeen
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.robot_signs import RobotSign
from rce_fleet.geometry.angles import yaw_of

if TYPE_CHECKING:
    from rce.ros.types import Message

_POSE_LENGTH = 3


def read_pose_seen(robot: str, message: Message) -> PoseSeen:
    """Return the event of a ``geometry_msgs/PoseWithCovarianceStamped``."""
    pose = message.pose.pose
    turn = pose.orientation
    return PoseSeen(robot, pose.position.x, pose.position.y, yaw_of(turn.x, turn.y, turn.z, turn.w))


def read_report(message: Message) -> ClientReport:
    """Return the report of a ``fleet/MoveStatus``."""
    return ClientReport(
        revision=message.revision,
        state=ClientState(message.state),
        cells=tuple(message.cells),
        reached=None if message.reached < 0 else message.reached,
        target=None if message.target < 0 else message.target,
    )


def read_sign(message: Message) -> RobotSign:
    """Return the signs of life of a ``fleet/MoveStatus``."""
    age = message.robot_age if message.robot_age >= 0 else None
    if len(message.pose) != _POSE_LENGTH:
        return RobotSign(age)
    x, y, yaw = message.pose
    return RobotSign(age, (x, y, yaw))
