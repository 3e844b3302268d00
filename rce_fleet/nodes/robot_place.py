"""Where the robot is and how it moves: from tf and odometry, with what is wrong with them."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, isfinite
from typing import TYPE_CHECKING

from rce.ros.tf import TransformError, TransformListener
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.nodes.planar import pose_of, read_twist

if TYPE_CHECKING:
    from rce.ros.node import Node
    from rce.ros.types import Message
    from rce_fleet.nodes.throttled_log import ThrottledLog

ODOMETRY_TIMEOUT = 0.5
"""Odometry older than this does not tell the robot's speeds any more, seconds."""
AHEAD = 1.0
"""A place by odometry that is dated this far into the future is not of now, seconds."""
MAP_AHEAD = 5.0
"""The same of the odometry's place on the map, which localization dates into the future on purpose."""
FORGET_EVERY = 5.0
"""Seconds between two times that transforms of the future are forgotten."""
JUMP = 1.0
"""A robot that moves by more than this between two control steps has jumped, metres."""


def full_name(transforms: TransformListener, frame: str) -> str:
    """Return the full name of a frame that a parameter names, with a slash before it.

    A name that begins with the robot's ``tf_prefix`` is full already.
    """
    prefix = transforms.prefix.strip("/")
    if prefix and frame.startswith(f"{prefix}/"):
        return f"/{frame}"
    return f"/{transforms.resolve(frame)}"


def named_in_message(frame: str) -> str:
    """Return the name of a frame in a message's header, which is full, with a slash before it."""
    return f"/{frame.lstrip('/')}"


@dataclass(frozen=True, slots=True)
class Place:
    """Where the robot is.

    Attributes:
        pose: In the local frame.
        local_from_global: Pose of the global frame in the local one.
        problem: Why it is not known; else empty.
        jumped: Whether odometry jumped since the last step.
    """

    pose: Pose
    local_from_global: Pose
    problem: str = ""
    jumped: bool = False


class RobotPlace:
    """Looks up where the robot is.

    Args:
        node: Running node.
        transforms: What is known of frames.
        frames: The global frame, the local frame and the robot's frame.
        tolerance: Oldest transform that counts, seconds.
        throttled_log: Where warnings go.
    """

    def __init__(
        self,
        node: Node,
        transforms: TransformListener,
        frames: tuple[str, str, str],
        tolerance: float,
        throttled_log: ThrottledLog,
    ) -> None:
        self._node = node
        self._transforms = transforms
        self._global, self._local, self._base = (full_name(transforms, frame) for frame in frames)
        self._tolerance = tolerance
        self._throttled_log = throttled_log
        self._last: Pose | None = None
        self._twist = Twist()
        self._moved_at = self._forgot_at = float("-inf")

    def take_odometry(self, message: Message) -> None:
        """Take the robot's speeds."""
        twist = read_twist(message.twist.twist)
        if not (isfinite(twist.speed) and isfinite(twist.turn_rate)):
            self._throttled_log.warn("odom", "odometry is ignored: its speeds are not finite")
            return
        self._twist, self._moved_at = twist, self._node.time()

    def speeds(self, commanded: Twist) -> Twist:
        """Return the robot's speeds; those commanded last if odometry is late."""
        late = not 0 <= self._node.time() - self._moved_at <= ODOMETRY_TIMEOUT
        return commanded if late else self._twist

    def look(self) -> Place:
        """Return where the robot is now."""
        nowhere = Pose(0.0, 0.0, 0.0)
        try:
            found = self._transforms.lookup(self._local, self._base)
            moved = self._transforms.lookup(self._local, self._global)
        except TransformError as error:
            return Place(nowhere, nowhere, f"waiting for transforms: {error}")
        now = self._node.time()
        for one, ahead in ((found, AHEAD), (moved, MAP_AHEAD)):
            age = now - one.stamp.to_sec()
            if not one.stamp or one.parent == one.child or -ahead <= age <= self._tolerance:
                continue
            text = f"the transform from {one.child} to {one.parent} is"
            if age > 0:
                why = f"{text} {age:.2f} s old (transform_tolerance {self._tolerance:.2f} s)"
            else:
                why = f"{text} {-age:.2f} s in the future: are the clocks of the machines in step?"
                self._forget_future(now)
            return Place(nowhere, nowhere, why)
        pose = pose_of(found.transform)
        last, self._last = self._last, pose
        jumped = last is not None and hypot(pose.x - last.x, pose.y - last.y) > JUMP
        return Place(pose, pose_of(moved.transform), jumped=jumped)

    def _forget_future(self, now: float) -> None:
        """Forget transforms: while there are those of the future, none of now are taken.

        A robot's clock was set back, perhaps, or a simulation began anew.
        """
        if not 0 <= now - self._forgot_at < FORGET_EVERY:
            self._forgot_at = now
            self._transforms.buffer.clear()
