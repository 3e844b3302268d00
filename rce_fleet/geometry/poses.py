"""Poses in the plane, one by one (:class:`Pose`) and many at once (arrays of shape (..., 3): x, y, yaw).

A pose is also the transform from its own frame to the frame that it is given in. Lengths are metres, angles
radians; x is forward, y left, yaw counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import TYPE_CHECKING, Self

import numpy as np

from rce_fleet.geometry.angles import wrap, wrap_array

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class Pose:
    """A position and direction in the plane: metres, radians."""

    x: float
    y: float
    yaw: float

    @classmethod
    def from_array(cls, values: Sequence[float] | NDArray[np.float64]) -> Self:
        """Return the pose of an array of shape (3,)."""
        x, y, yaw = values
        return cls(float(x), float(y), float(yaw))

    def as_array(self) -> NDArray[np.float64]:
        """Return ``[x, y, yaw]``, shape (3,)."""
        return np.array((self.x, self.y, self.yaw))

    def compose(self, other: Pose) -> Pose:
        """Return ``other``, which is given in this pose's frame, in the frame of this pose."""
        c, s = cos(self.yaw), sin(self.yaw)
        return Pose(
            self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y, wrap(self.yaw + other.yaw)
        )

    def inverse(self) -> Pose:
        """Return the pose of this pose's parent frame, seen from this pose."""
        c, s = cos(self.yaw), sin(self.yaw)
        return Pose(-c * self.x - s * self.y, s * self.x - c * self.y, wrap(-self.yaw))

    def relative_to(self, base: Pose) -> Pose:
        """Return this pose as seen from ``base``: ``base.compose(pose.relative_to(base))`` is ``pose``."""
        return base.inverse().compose(self)


@dataclass(frozen=True, slots=True)
class Twist:
    """A forward speed, metres per second, and a turn rate, radians per second."""

    speed: float = 0.0
    turn_rate: float = 0.0


# Arrays. The leading shapes of two arguments broadcast, so one pose goes with many.


def compose(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return ``b``, given in the frames of ``a``, in the parent frame of ``a``; yaw within -pi .. pi.

    Args:
        a: shape (..., 3).
        b: shape (..., 3).
    """
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    c, s = np.cos(first[..., 2]), np.sin(first[..., 2])
    return np.stack(
        (
            first[..., 0] + c * second[..., 0] - s * second[..., 1],
            first[..., 1] + s * second[..., 0] + c * second[..., 1],
            wrap_array(first[..., 2] + second[..., 2]),
        ),
        axis=-1,
    )


def inverse(a: ArrayLike) -> NDArray[np.float64]:
    """Return the poses of the parent frame, seen from each pose of ``a``, shape (..., 3)."""
    poses = np.asarray(a, np.float64)
    x, y = poses[..., 0], poses[..., 1]
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return np.stack((-c * x - s * y, s * x - c * y, wrap_array(-poses[..., 2])), axis=-1)


def relative(base: ArrayLike, poses: ArrayLike) -> NDArray[np.float64]:
    """Return ``poses`` as seen from ``base``, both of shape (..., 3) in one frame."""
    return compose(inverse(base), poses)


def transform_points(pose: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Return points that are given in the frame of a pose, in the parent frame of the pose.

    Args:
        pose: shape (..., 3).
        points: shape (..., 2); the leading shapes broadcast.
    """
    frame, local = np.asarray(pose, np.float64), np.asarray(points, np.float64)
    c, s = np.cos(frame[..., 2]), np.sin(frame[..., 2])
    x, y = local[..., 0], local[..., 1]
    return np.stack((frame[..., 0] + c * x - s * y, frame[..., 1] + s * x + c * y), axis=-1)
