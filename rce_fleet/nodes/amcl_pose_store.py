"""Stores the pose of ``amcl`` in its parameters, from which it begins when it is started again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.nodes.kept_pose import KeptPose, StoredPose, boot_id

if TYPE_CHECKING:
    from rce.ros.node import Node
    from rce_fleet.geometry.poses import Pose
    from rce_fleet.nodes.amcl_parameters import AmclNodeParameters

ODOMETRY_ERROR = 0.2
"""Error of the odometry, as a share of the way that the robot drove while the node was away."""
LEAST_ERROR = 0.05
"""Standard deviation that a stored pose gets in addition, metres and radians."""
SAME = 1e-6
"""Numbers of two parameters that differ by less are of the same pose, metres and radians."""


class PoseStore:
    """The parameters ``initial_pose_*`` and ``initial_cov_*`` of ROS 1's node, and ``stored_pose``.

    A robot goes on driving or turning when its localization dies. So ``stored_pose`` holds the odometry of
    the pose's time, too, and a node that is started again takes what the robot has moved since into account.

    Args:
        node: Has the parameters.
        parameters: What they were when the node started.
    """

    def __init__(self, node: Node, parameters: AmclNodeParameters) -> None:
        self._node = node
        self._boot = boot_id()
        self._saved: KeptPose | None = None
        self._found = self._read(parameters)

    def _read(self, parameters: AmclNodeParameters) -> StoredPose | None:
        if not parameters.stored_pose:
            return None
        try:
            found = StoredPose.from_json(parameters.stored_pose)
        except ValueError as error:
            self._node.log.warning("%s is not used: %s", self._node.resolve("~stored_pose"), error)
            return None
        pose = found.kept.pose
        initial = (parameters.initial_pose_x, parameters.initial_pose_y, parameters.initial_pose_a)
        is_newest = bool(np.isclose(initial, pose.as_array(), rtol=0.0, atol=SAME).any())
        return found if is_newest else None  # else an initial pose was set since

    def forget(self) -> None:
        """Do not begin at the stored pose: the robot was told where it is."""
        self._found = None

    def take(self, odometry: Pose, time: float) -> KeptPose | None:
        """Return, once, where the robot is by the stored pose and the odometry since; None if not known.

        Args:
            odometry: Pose by odometry now.
            time: Of this odometry, seconds of ROS time.
        """
        found, self._found = self._found, None
        if found is None:
            return None
        before = found.resume(odometry, self._boot, time)
        pose, covariance = before.moved_on(odometry, ODOMETRY_ERROR, LEAST_ERROR)
        return KeptPose(before.frame, pose, covariance, odometry)

    async def save(self, kept: KeptPose, time: float) -> None:
        """Store a pose, if it is another one than before.

        ``stored_pose`` counts only while ``initial_pose_*`` are those of the same pose. It is set between
        them: whenever the node dies here, one of them fits.

        Args:
            kept: The pose.
            time: When the robot was there, seconds of ROS time.

        Raises:
            RosError: The master does not take it.
        """
        if kept is self._saved:
            return
        pose, covariance = kept.pose, kept.covariance
        values: dict[str, float | str] = {
            "initial_pose_x": pose.x,
            "initial_pose_y": pose.y,
            "stored_pose": StoredPose(kept, self._boot, time).to_json(),
            "initial_pose_a": pose.yaw,
            "initial_cov_xx": float(covariance[0, 0]),
            "initial_cov_yy": float(covariance[1, 1]),
            "initial_cov_aa": float(covariance[2, 2]),
        }
        for name, value in values.items():
            await self._node.set_param(f"~{name}", value)
        self._saved = kept
