"""Angles in radians, counter-clockwise positive; for numbers, and for arrays of any shape."""

from __future__ import annotations

from math import atan2, cos, pi, sin
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def wrap(angle: float) -> float:
    """Return the same direction within -pi (exclusive) .. pi."""
    wrapped = (angle + pi) % (2 * pi) - pi
    return pi if wrapped == -pi else wrapped


def wrap_array(angles: ArrayLike) -> NDArray[np.float64]:
    """Return the same directions within -pi (exclusive) .. pi, in an array of the same shape."""
    wrapped = np.asarray((np.asarray(angles, np.float64) + pi) % (2 * pi) - pi)
    wrapped[wrapped == -pi] = pi
    return wrapped


def difference(angle: float, base: float) -> float:
    """Return the turn from ``base`` to ``angle`` on the shorter way, within -pi .. pi."""
    return wrap(angle - base)


def circular_mean(angles: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Return the mean direction of shape (N,) angles.

    This is the direction of the sum of the unit vectors (Mardia and Jupp, Directional Statistics, 2.2). If
    they cancel out, every direction is equally good and the result is 0.

    Args:
        angles: shape (N,).
        weights: shape (N,), at least 0; all the same by default.
    """
    values = np.asarray(angles, np.float64)
    share = np.ones_like(values) if weights is None else np.asarray(weights, np.float64)
    return atan2(float(share @ np.sin(values)), float(share @ np.cos(values)))


def quaternion_z(yaw: float) -> tuple[float, float]:
    """Return ``(z, w)`` of the unit quaternion of a rotation about z; x and y are 0."""
    return sin(yaw / 2), cos(yaw / 2)


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Return the rotation about z of a unit quaternion."""
    return atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
