"""Places frames on the map: by the robot's transforms, else by its newest pose. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rce.ros.tf import Buffer, StampedTransform, TransformError, Vector
from rce.ros.tf.exceptions import ExtrapolationError
from rce.ros.types import Time, TypesError
from rce_fleet.station.layers.frames import LayerError, Placement

if TYPE_CHECKING:
    from rce.ros.types import TypeRegistry
    from rce_fleet.station.view import Pose

MAP_FRAME = "map"
LATE_S = 0.15
"""Difference between the times of a message and its transform from which the operator is told."""
JUMP_S = 1.0
"""A transform that is older than the last one by this time shows that time began anew."""
NANOSECONDS = 1_000_000_000


class RobotTransforms:
    """The transforms of one robot.

    Args:
        types: Knows the message types.
        pose: Returns the robot's newest pose on the map; None if it is unknown.
    """

    def __init__(self, types: TypeRegistry, pose: Callable[[], Pose | None]) -> None:
        self._type = types.message("tf2_msgs/TFMessage")
        self._buffer = Buffer()
        self._pose = pose
        self._newest = 0

    def take(self, payload: bytes | bytearray | memoryview) -> None:
        """Handle a message of ``/tf``, a serialized ``tf2_msgs/TFMessage``; leave out invalid transforms."""
        self._take(payload, static=False)

    def take_static(self, payload: bytes | bytearray | memoryview) -> None:
        """Handle a message of ``/tf_static``, in the same way."""
        self._take(payload, static=True)

    def _take(self, payload: bytes | bytearray | memoryview, *, static: bool) -> None:
        try:
            message = self._type.deserialize(memoryview(payload))
        except TypesError:
            return  # The lookups say what is missing.
        for entry in message.transforms:
            try:
                transform = StampedTransform.read(entry)
            except TransformError:
                continue
            if not static:
                self._notice_jump(transform.stamp.to_nsec())
            self._buffer.insert(transform, static=static)

    def place(self, frame: str, stamp_ns: int, *, on_robot: bool = False) -> Placement:
        """Return where a frame was on the map at a time.

        Args:
            frame: The frame of a message.
            stamp_ns: The message's time, nanoseconds; 0: now.
            on_robot: The frame is fixed to the robot: without transforms, the robot's pose stands for it.

        Raises:
            LayerError: The place is unknown.
        """
        name = frame.lstrip("/")
        prefix = name.rpartition("/")[0]
        if name in (MAP_FRAME, f"{prefix}/{MAP_FRAME}"):
            return Placement((0.0, 0.0, 0.0))
        reasons = []
        for target in dict.fromkeys((MAP_FRAME, f"{prefix}/{MAP_FRAME}" if prefix else MAP_FRAME)):
            try:
                return self._look_up(target, name, stamp_ns)
            except TransformError as error:
                reasons.append(str(error))
        pose = self._pose()
        if pose is None or not on_robot:
            raise LayerError(f"frame {name!r} cannot be placed on the map: {reasons[0]}")
        return Placement((pose.x, pose.y, pose.theta), "placed by the robot's pose, without transforms")

    def _look_up(self, target: str, frame: str, stamp_ns: int) -> Placement:
        try:
            found = self._buffer.lookup(target, frame, Time(*divmod(stamp_ns, NANOSECONDS)))
            note = ""
        except ExtrapolationError:
            found = self._buffer.lookup(target, frame)
            apart = (stamp_ns - found.stamp.to_nsec()) / NANOSECONDS
            which = "older" if apart > 0 else "newer"
            note = f"placed by a transform that is {abs(apart):.1f} s {which}" if abs(apart) > LATE_S else ""
        moved = found.transform.translation
        up = found.transform.rotation.rotate(Vector(z=1.0))
        return Placement((moved.x, moved.y, found.transform.yaw), note, is_upside_down=up.z < 0)

    def _notice_jump(self, stamp_ns: int) -> None:
        """Forget transforms from before a simulation that began anew."""
        if stamp_ns < self._newest - JUMP_S * NANOSECONDS:
            self._buffer.clear()
            self._newest = stamp_ns
        self._newest = max(self._newest, stamp_ns)
