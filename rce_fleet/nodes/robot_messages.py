"""Reads what robots and their move clients send to the planner."""

from __future__ import annotations

from math import hypot, isfinite, sqrt
from typing import TYPE_CHECKING

from rce_fleet.coordination.answers import read_client_state, read_revision
from rce_fleet.coordination.events import PoseSeen
from rce_fleet.coordination.move_client import ClientReport
from rce_fleet.coordination.robot_signs import RobotSign
from rce_fleet.geometry.angles import yaw_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.ros.types import Message

_POSE_LENGTH = 3


def read_pose_seen(robot: str, message: Message) -> PoseSeen:
    """Return the event of a ``geometry_msgs/PoseWithCovarianceStamped``."""
    pose = message.pose.pose
    turn = pose.orientation
    yaw = yaw_of(turn.x, turn.y, turn.z, turn.w)
    return PoseSeen(robot, pose.position.x, pose.position.y, yaw, *_spreads(message.pose.covariance))


def _spreads(covariance: Sequence[float]) -> tuple[float | None, float | None]:
    """Return standard deviations of place (worst direction, metres) and heading (radians).

    Args:
        covariance: Row by row, of x, y, z and the rotations about them.

    Returns:
        None for numbers that are not a covariance: not finite, or negative.
    """
    xx, xy, yy, turn = covariance[0], covariance[1], covariance[7], covariance[35]
    # The larger eigenvalue of the symmetric matrix [[xx, xy], [xy, yy]].
    largest = (xx + yy) / 2 + hypot((xx - yy) / 2, xy)
    spread = sqrt(largest) if isfinite(largest) and largest >= 0 else None
    return spread, sqrt(turn) if isfinite(turn) and turn >= 0 else None


def read_report(message: Message) -> ClientReport:
    """Return the report of a ``fleet/MoveStatus``.

    Raises:
        ValueError: No move client has this state, or its list this number.
    """
    return ClientReport(
        revision=read_revision(message.revision),
        state=read_client_state(message.state),
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
