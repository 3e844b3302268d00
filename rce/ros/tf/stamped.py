"""Transforms with their frames and time, and the message that carries them. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rce.ros.tf.exceptions import BadTransformError
from rce.ros.tf.frames import strip
from rce.ros.tf.transform import Quaternion, Transform, Vector
from rce.ros.types.values import Time

if TYPE_CHECKING:
    from rce.ros.types import Message

MAX_LENGTH_ERROR = 1e-2
"""How far a quaternion's squared length may be from 1, as in tf2."""


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """An edge of the tree of frames at one time.

    Attributes:
        parent: The frame that coordinates are taken to; ``target``.
        child: The frame that they are taken from; ``source``.
        transform: ``parent_from_child``.
        stamp: When it holds; zero: always (the answer to a lookup over static edges only).
    """

    parent: str
    child: str
    transform: Transform
    stamp: Time = field(default_factory=Time)

    @classmethod
    def read(cls, message: Message) -> StampedTransform:
        """Read a ``geometry_msgs/TransformStamped``; a slash before a frame's name is dropped.

        Raises:
            BadTransformError: It has no frames, or not two, or values that are not a transform.
        """
        moved, turned = message.transform.translation, message.transform.rotation
        transform = Transform(
            Vector(moved.x, moved.y, moved.z), Quaternion(turned.x, turned.y, turned.z, turned.w)
        )
        stamped = cls(
            strip(message.header.frame_id), strip(message.child_frame_id), transform, message.header.stamp
        )
        stamped.check()
        return stamped

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of a ``geometry_msgs/TransformStamped``."""
        return {
            "header": {"stamp": self.stamp, "frame_id": self.parent},
            "child_frame_id": self.child,
            "transform": {
                "translation": self.transform.translation._asdict(),
                "rotation": self.transform.rotation._asdict(),
            },
        }

    def check(self) -> None:
        """Check that it can be an edge of a tree.

        Raises:
            BadTransformError: It cannot.
        """
        name = f"transform from {self.child!r} to {self.parent!r}"
        if not self.parent or not self.child:
            raise BadTransformError(f"{name}: a frame's name is empty")
        if self.parent == self.child:
            raise BadTransformError(f"{name}: a frame cannot be its own parent")
        rotation = self.transform.rotation
        if not all(map(math.isfinite, (*self.transform.translation, *rotation))):
            raise BadTransformError(f"{name}: a value is not a finite number")
        if abs(rotation.dot(rotation) - 1) > MAX_LENGTH_ERROR:
            raise BadTransformError(
                f"{name}: the rotation's quaternion has length {rotation.length:g}, not 1"
            )
