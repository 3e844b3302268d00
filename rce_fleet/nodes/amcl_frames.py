"""The transforms that ``amcl`` needs: where the laser is on the robot, and what the odometry says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.ros.tf import StampedTransform, Transform, TransformBroadcaster, TransformError, TransformListener
from rce.ros.types import Time
from rce_fleet.geometry.poses import Pose
from rce_fleet.nodes.planar import pose_of

if TYPE_CHECKING:
    from rce_fleet.nodes.amcl_parameters import AmclNodeParameters

WAIT = 0.5
"""Seconds that a scan waits for its transforms."""


class RobotFrames:
    """Looks transforms up, and publishes ``map`` -> ``odom``.

    Args:
        parameters: Names of the frames.
        listener: Hears transforms.
        broadcaster: Sends them.
    """

    def __init__(
        self, parameters: AmclNodeParameters, listener: TransformListener, broadcaster: TransformBroadcaster
    ) -> None:
        self._parameters = parameters
        self._listener = listener
        self._broadcaster = broadcaster
        self._lasers: dict[str, Transform] = {}

    @property
    def map_frame(self) -> str:
        """The full name of the map's frame."""
        return self._listener.resolve(self._parameters.global_frame_id)

    def is_map(self, frame: str) -> bool:
        """Return whether a message's frame is that of the map."""
        return frame.lstrip("/") in (self._parameters.global_frame_id.lstrip("/"), self.map_frame)

    async def laser(self, frame: str) -> Transform:
        """Return ``base_from_laser``, which never changes.

        Raises:
            TransformError: It did not become known in time.
        """
        if frame not in self._lasers:
            found = await self._listener.wait_for(
                self._parameters.base_frame_id, f"/{frame.lstrip('/')}", timeout=WAIT
            )
            self._lasers[frame] = found.transform
        return self._lasers[frame]

    async def odometry(self, stamp: Time) -> Pose:
        """Return the pose by odometry at a time.

        Raises:
            TransformError: It did not become known in time.
        """
        names = self._parameters
        found = await self._listener.wait_for(names.odom_frame_id, names.base_frame_id, stamp, timeout=WAIT)
        return pose_of(found.transform)

    def odometry_now(self) -> Pose | None:
        """Return the latest pose by odometry; None if there is none yet."""
        try:
            found = self._listener.lookup(self._parameters.odom_frame_id, self._parameters.base_frame_id)
        except TransformError:
            return None
        return pose_of(found.transform)

    def moved_since(self, stamp: Time) -> Pose:
        """Return how far the robot has driven since a time; nowhere if that is not known."""
        names = self._parameters
        if not stamp:
            return Pose(0.0, 0.0, 0.0)
        try:
            moved = self._listener.lookup_full(
                names.base_frame_id, stamp, names.base_frame_id, None, names.odom_frame_id
            )
        except TransformError:
            return Pose(0.0, 0.0, 0.0)
        return pose_of(moved.transform)

    def send(self, map_from_odom: Pose, stamp: Time) -> None:
        """Publish where the odometry is on the map, valid ``transform_tolerance`` longer than the scan."""
        names = self._parameters
        until = Time.from_sec(stamp.to_sec() + names.transform_tolerance)
        transform = Transform.make(map_from_odom.x, map_from_odom.y, yaw=map_from_odom.yaw)
        self._broadcaster.send_stamped(
            StampedTransform(names.global_frame_id, names.odom_frame_id, transform, until)
        )
