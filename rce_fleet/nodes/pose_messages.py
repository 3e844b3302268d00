"""Poses with their covariance in the plane as ROS messages, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rce_fleet.nodes.planar import pose_fields, read_pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce.ros.types import Message
    from rce_fleet.geometry.poses import Pose

PLANE = np.ix_((0, 1, 5), (0, 1, 5))
"""Rows and columns of x, y and yaw in a message's covariance of 6 x 6."""


def read_pose_with_covariance(message: Message) -> tuple[Pose, NDArray[np.float64]]:
    """Return the pose of a ``geometry_msgs/PoseWithCovariance`` and its covariance, shape (3, 3): x, y, yaw.

    Raises:
        ValueError: A number is not finite, the rotation is not about z, or a variance is negative.
    """
    pose = read_pose(message.pose)
    covariance = np.asarray(message.covariance, np.float64).reshape(6, 6)[PLANE]
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
        raise ValueError("the covariance must be finite, and not negative on its diagonal")
    return pose, (covariance + covariance.T) / 2


def pose_with_covariance_fields(pose: Pose, covariance: NDArray[np.float64]) -> dict[str, Any]:
    """Return the fields of a ``geometry_msgs/PoseWithCovariance``.

    Args:
        pose: The pose.
        covariance: shape (3, 3): x, y, yaw.
    """
    whole = np.zeros((6, 6))
    whole[PLANE] = covariance
    return {"pose": pose_fields(pose), "covariance": whole.reshape(-1).tolist()}
