"""Poses and transforms in the plane as ROS messages, and back."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.tf import Vector
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.angles import quaternion_z, yaw_of
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.maps.occupancy_map import OccupancyMap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce.ros.tf import Transform
    from rce.ros.types import Message

_LEAST_TURN = 1e-3
"""A quaternion shorter than this is not a rotation."""
_NO_TURN = (0.0, 0.0, 0.0, 1.0)
_UP = Vector(0.0, 0.0, 1.0)


def pose_of(transform: Transform) -> Pose:
    """Return a transform's part in the plane."""
    return Pose(transform.translation.x, transform.translation.y, transform.yaw)


def angles_from_above(mounted: Transform, angle_min: float, angle_increment: float) -> tuple[float, float]:
    """Return the direction of a scan's first beam and the angle to the next, counter-clockwise from above.

    They count from the yaw of :func:`pose_of`. A lidar that is mounted upside down turns clockwise.

    Args:
        mounted: The lidar's frame in one whose z points upwards.
        angle_min: Direction of the first beam in the lidar's frame, radians.
        angle_increment: Angle from one beam to the next there, radians.
    """
    turn = -1.0 if mounted.rotation.rotate(_UP).z < 0 else 1.0
    return turn * angle_min, turn * angle_increment


def read_pose(message: Message) -> Pose:
    """Return a ``geometry_msgs/Pose`` in the plane.

    Raises:
        ValueError: A number is not finite, or the orientation is not a rotation about z.
    """
    turn = message.orientation
    return _pose_in_plane(message.position, (turn.x, turn.y, turn.z, turn.w))


def _pose_in_plane(at: Message, turn: tuple[float, float, float, float]) -> Pose:
    """Return the pose of a position and of a quaternion x, y, z, w; raise as :func:`read_pose`."""
    if not all(map(isfinite, (at.x, at.y, *turn))):
        raise ValueError(f"the pose ({at.x}, {at.y}) has numbers that are not finite")
    length = sum(value * value for value in turn) ** 0.5
    if length < _LEAST_TURN:
        raise ValueError(
            "the orientation is (0, 0, 0, 0), which is not a rotation; (0, 0, 0, 1) is straight ahead"
        )
    x, y, z, w = (value / length for value in turn)
    if x * x + y * y > 0.1:  # noqa: PLR2004 - upright by less than about 35 degrees
        raise ValueError("the orientation is not a rotation about z: the robot would not stand upright")
    return Pose(at.x, at.y, yaw_of(x, y, z, w))


def pose_fields(pose: Pose) -> dict[str, Any]:
    """Return the fields of a ``geometry_msgs/Pose``."""
    z, w = quaternion_z(pose.yaw)
    return {"position": {"x": pose.x, "y": pose.y}, "orientation": {"z": z, "w": w}}


def twist_fields(twist: Twist) -> dict[str, Any]:
    """Return the fields of a ``geometry_msgs/Twist``."""
    return {"linear": {"x": twist.speed}, "angular": {"z": twist.turn_rate}}


def read_twist(message: Message) -> Twist:
    """Return a ``geometry_msgs/Twist`` in the plane."""
    return Twist(message.linear.x, message.angular.z)


def path_fields(poses: NDArray[np.float64], header: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a ``nav_msgs/Path`` of poses, shape (N, 3)."""
    stamped = [{"header": header, "pose": pose_fields(Pose.from_array(one))} for one in poses]
    return {"header": header, "poses": stamped}


def read_map(message: Message) -> OccupancyMap:
    """Return a ``nav_msgs/OccupancyGrid``. An origin with the orientation (0, 0, 0, 0) is not turned.

    Raises:
        ValueError: Its size, resolution, values or origin are not those of a map.
    """
    info = message.info
    values, turn = np.asarray(message.data, np.int16), info.origin.orientation
    quaternion = (turn.x, turn.y, turn.z, turn.w)
    # octomap_server and others never set it, and ROS's nodes read past it.
    place = _pose_in_plane(info.origin.position, quaternion if any(quaternion) else _NO_TURN)
    try:
        return OccupancyMap.from_message(info.width, info.height, values, info.resolution, place)
    except MapError as error:
        raise ValueError(str(error)) from error


def fault_of_map_frame(message: Message, expected: str) -> str:
    """Return what is wrong with the frame of a map's header; empty if nothing is.

    Args:
        message: A ``nav_msgs/OccupancyGrid``.
        expected: Full name of the frame that it should be in.
    """
    frame = message.header.frame_id.lstrip("/")
    if not frame or frame == expected.lstrip("/"):
        return ""
    return f"it is in frame {frame!r}, expected {expected.lstrip('/')!r}; its poses are used as they are"
