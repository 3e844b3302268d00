"""Angles in radians, counter-clockwise positive."""

from __future__ import annotations

from math import atan2, cos, pi, sin


def wrap(angle: float) -> float:
    """Return the same direction within -pi (exclusive) .. pi."""
    wrapped = (angle + pi) % (2 * pi) - pi
    return pi if wrapped == -pi else wrapped


def quaternion_z(yaw: float) -> tuple[float, float]:
    """Return ``(z, w)`` of the unit quaternion of a rotation about z; x and y are 0."""
    return sin(yaw / 2), cos(yaw / 2)


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Return the rotation about z of a unit quaternion."""
    return atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
