"""Rigid transforms: a rotation and a translation, in plain Python. Pure.

``target_from_source`` takes coordinates in ``source`` to coordinates in ``target``; in ROS's messages
``target`` is the parent (``header.frame_id``) and ``source`` the child. Transforms are chained by ``@``:
``a_from_c = a_from_b @ b_from_c``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Self

_STRAIGHT = 1e-9
"""Sine of the angle between two rotations below which a straight line replaces the arc."""


class Vector(NamedTuple):
    """A point or translation, metres."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(NamedTuple):
    """A rotation, as a quaternion of length 1; ``q`` and ``-q`` are the same rotation."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0

    @classmethod
    def from_euler(cls, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Self:
        """Make a rotation about the fixed axes x, then y, then z; radians, counter-clockwise positive."""
        sr, cr = math.sin(roll / 2), math.cos(roll / 2)
        sp, cp = math.sin(pitch / 2), math.cos(pitch / 2)
        sy, cy = math.sin(yaw / 2), math.cos(yaw / 2)
        return cls(
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )

    def to_euler(self) -> tuple[float, float, float]:
        """Return roll, pitch and yaw, radians; the reverse of :meth:`from_euler`."""
        x, y, z, w = self
        sine = 2 * (w * y - z * x)
        return (
            math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            math.asin(max(-1.0, min(1.0, sine))),
            math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        )

    @property
    def length(self) -> float:
        """1 for a rotation."""
        return math.sqrt(self.dot(self))

    def dot(self, other: Quaternion) -> float:
        """Return the cosine of half the angle between two rotations."""
        return self.x * other.x + self.y * other.y + self.z * other.z + self.w * other.w

    def normalized(self) -> Quaternion:
        """Return the quaternion with length 1.

        Raises:
            ZeroDivisionError: Its length is 0.
        """
        length = self.length
        return Quaternion(self.x / length, self.y / length, self.z / length, self.w / length)

    def inverse(self) -> Quaternion:
        """Return the rotation back."""
        return Quaternion(-self.x, -self.y, -self.z, self.w)

    def __matmul__(self, other: Quaternion) -> Quaternion:
        """Return the rotation by ``other``, then by this one."""
        ax, ay, az, aw = self
        bx, by, bz, bw = other
        return Quaternion(
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )

    def rotate(self, point: Vector) -> Vector:
        """Rotate a point about the origin."""
        x, y, z, w = self
        px, py, pz = point
        tx, ty, tz = 2 * (y * pz - z * py), 2 * (z * px - x * pz), 2 * (x * py - y * px)
        return Vector(
            px + w * tx + y * tz - z * ty,
            py + w * ty + z * tx - x * tz,
            pz + w * tz + x * ty - y * tx,
        )

    def slerp(self, other: Quaternion, fraction: float) -> Quaternion:
        """Return the rotation on the shortest arc to ``other``; 0 is this one, 1 the other."""
        cosine = self.dot(other)
        if cosine < 0:
            cosine, other = -cosine, Quaternion(*(-value for value in other))
        angle = math.acos(min(1.0, cosine))
        sine = math.sin(angle)
        if sine < _STRAIGHT:
            mine, others = 1 - fraction, fraction
        else:
            mine = math.sin((1 - fraction) * angle) / sine
            others = math.sin(fraction * angle) / sine
        blend = (mine * a + others * b for a, b in zip(self, other, strict=True))
        return Quaternion(*blend).normalized()


ORIGIN = Vector()
UNTURNED = Quaternion()


@dataclass(frozen=True, slots=True)
class Transform:
    """A rotation, then a translation.

    Attributes:
        translation: Where the source's origin is in the target, metres.
        rotation: How the source is turned in the target.
    """

    translation: Vector = ORIGIN
    rotation: Quaternion = UNTURNED

    @classmethod
    def make(
        cls,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        *,
        roll: float = 0.0,
        pitch: float = 0.0,
        yaw: float = 0.0,
    ) -> Self:
        """Make a transform of metres and radians."""
        return cls(Vector(x, y, z), Quaternion.from_euler(roll, pitch, yaw))

    @property
    def yaw(self) -> float:
        """The angle about z, radians; in a plane, this is the whole rotation."""
        return self.rotation.to_euler()[2]

    def __matmul__(self, other: Transform) -> Transform:
        """Chain: ``a_from_b @ b_from_c`` is ``a_from_c``."""
        return Transform(self.apply(other.translation), self.rotation @ other.rotation)

    def apply(self, point: Iterable[float]) -> Vector:
        """Take a point's coordinates ``(x, y, z)`` from the source to the target."""
        turned = self.rotation.rotate(Vector(*point))
        moved = self.translation
        return Vector(turned.x + moved.x, turned.y + moved.y, turned.z + moved.z)

    def inverse(self) -> Transform:
        """Return ``source_from_target``."""
        back = self.rotation.inverse()
        x, y, z = back.rotate(self.translation)
        return Transform(Vector(-x, -y, -z), back)

    def interpolate(self, other: Transform, fraction: float) -> Transform:
        """Interpolate: 0 is this one, 1 the other; translations on a line, rotations on an arc."""
        blend = (a + fraction * (b - a) for a, b in zip(self.translation, other.translation, strict=True))
        return Transform(Vector(*blend), self.rotation.slerp(other.rotation, fraction))

    def matrix(self) -> tuple[tuple[float, float, float, float], ...]:
        """Return the 4x4 matrix as rows; ``numpy.array`` takes it as shape (4, 4)."""
        columns = [self.rotation.rotate(Vector(*axis)) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
        rows = zip(*columns, self.translation, strict=True)
        return (*rows, (0.0, 0.0, 0.0, 1.0))
