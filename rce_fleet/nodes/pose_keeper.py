"""Keeps a robot's pose while its localization is away. Runs on a robot whose ``amcl`` runs in its container.

It subscribes to ``amcl_pose`` and to the odometry on tf, and answers the service ``last_pose``: the last pose
on the map, moved on by odometry. An ``amcl`` that was started again asks for it (``~last_pose_timeout``) and
so begins where the robot is, not where it was in the morning. The pose is stored in a file, too, which is
read when the robot is switched on again.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.node import Message, Node, RosError, Time, run
from rce.ros.tf import TransformError, TransformListener
from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose
from rce_fleet.nodes.kept_pose import KeptPose, StoredPose, boot_id, default_path, read_stored_pose
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import pose_of
from rce_fleet.nodes.pose_messages import pose_with_covariance_fields, read_pose_with_covariance
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from collections.abc import Callable


SERVICE, TYPE = "last_pose", "fleet/GetLastPose"
ANSWER_TIMEOUT = 2.0
"""Seconds for an answer, until the question is asked again."""
RETRY = 0.5
"""Seconds between two questions."""
WATCH_EVERY = 0.2
"""Seconds between two looks at the odometry."""
WRITE_EVERY = 1.0
"""Seconds between two writes to the file."""
STILL = 0.005
"""A robot that moved less than this is not stored anew, metres and radians."""
TRANSFORM_TIMEOUT = 0.5
"""Seconds that a pose waits for the odometry of its time."""


@dataclass(frozen=True)
class PoseKeeperParameters:
    """Parameters of the node.

    Attributes:
        odom_frame_id: Frame of the odometry.
        base_frame_id: Frame of the robot's base.
        odom_error: Error of the odometry, as a share of the way; widens the pose that is answered.
        least_error: Standard deviation of the answered pose at least, metres and radians.
        store: Store the pose in a file, and begin with it.
        pose_file: This file; by default one in ``ROS_HOME``.
        restart_error: Standard deviation that is added to a pose of the file, metres and radians: the
            robot may have been pushed while it was off.
    """

    odom_frame_id: str = "odom"
    base_frame_id: str = "base_link"
    odom_error: float = field(default=0.2, metadata={"minimum": 0.0})
    least_error: float = field(default=0.05, metadata={"above": 0.0})
    store: bool = True
    pose_file: str = ""
    restart_error: float = field(default=0.2, metadata={"minimum": 0.0})


class PoseKeeper:
    """The last pose of a robot, in its ROS graph.

    Args:
        node: A running node.
        parameters: Its parameters.
    """

    def __init__(self, node: Node, parameters: PoseKeeperParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._throttled_log = ThrottledLog(node)
        self._watch = OdometryWatch()
        self._odometry: Pose | None = None
        self._kept: KeptPose | None = None
        self._path = (
            Path(parameters.pose_file).expanduser()
            if parameters.pose_file
            else default_path(node.master_uri, node.name)
        )
        self._boot = boot_id()
        self._stored: StoredPose | None = None
        self._written: KeptPose | None = None
        self._write_at = 0.0
        self._tf: TransformListener

    async def run(self) -> None:
        """Keep the pose until the node is stopped."""
        node = self._node
        if self._parameters.store:
            self._stored = await asyncio.to_thread(self._read)
        async with AsyncExitStack() as stack:
            self._tf = await stack.enter_async_context(TransformListener(node, prefix=""))
            await node.subscribe(
                "amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", self._take, queue_size=1
            )
            await node.advertise_service(SERVICE, TYPE, self._answer)
            try:
                while await node.sleep(WATCH_EVERY):
                    self._look()
                    if self._parameters.store and time.monotonic() >= self._write_at:
                        self._write_at = time.monotonic() + WRITE_EVERY
                        await asyncio.to_thread(self._write)
            finally:
                if self._parameters.store:
                    self._write()

    def _read(self) -> StoredPose | None:
        try:
            return read_stored_pose(self._path)
        except (OSError, ValueError) as error:
            self._node.log.warning("the stored pose is not used: %s: %s", self._path, error)
            return None

    def _write(self) -> None:
        """Store the pose, moved on to the newest odometry, if the robot has moved since."""
        kept, odometry = self._kept, self._odometry
        if kept is None or odometry is None:
            return
        pose, covariance = kept.moved_on(odometry, self._parameters.odom_error, 0.0)
        now = KeptPose(kept.frame, pose, covariance, odometry)
        if self._written is not None and _is_same(now, self._written):
            return
        try:
            StoredPose(now, self._boot, self._node.time()).write(self._path)
        except OSError as error:
            self._throttled_log.warn("file", f"the pose cannot be stored: {self._path}: {error}")
        else:
            self._written = now

    async def _take(self, message: Message) -> None:
        """Keep a pose of the localization, with the odometry of its time."""
        try:
            pose, covariance = read_pose_with_covariance(message.pose)
            odometry = await self._odometry_at(message.header.stamp)
        except (ValueError, TransformError) as error:
            self._throttled_log.warn("pose", f"a pose is not kept: {error}")
            return
        self._kept = KeptPose(message.header.frame_id, pose, covariance, odometry)
        self._stored = None

    async def _odometry_at(self, stamp: Time) -> Pose:
        names = self._parameters
        found = await self._tf.wait_for(
            names.odom_frame_id, names.base_frame_id, stamp, timeout=TRANSFORM_TIMEOUT
        )
        return pose_of(found.transform)

    def _look(self) -> None:
        """Note the odometry; when it jumped, the robot did not."""
        names = self._parameters
        try:
            found = self._tf.lookup(names.odom_frame_id, names.base_frame_id)
        except TransformError:
            return
        odometry, before = pose_of(found.transform), self._odometry
        jump = self._watch.check(odometry, self._node.time())
        if jump and self._kept is not None and before is not None:
            self._throttled_log.warn("odometry", f"{jump}; the pose before it is kept")
            pose, covariance = self._kept.moved_on(before, self._parameters.odom_error, 0.0)
            self._kept = KeptPose(self._kept.frame, pose, covariance, odometry)
        self._odometry = odometry
        if self._stored is not None and self._kept is None:
            kept = self._stored.resume(odometry, self._boot, self._node.time())
            wider = kept.covariance + np.diag((self._parameters.restart_error**2,) * 3)
            self._kept = KeptPose(kept.frame, kept.pose, wider, kept.odometry)
            self._stored = None
            at = kept.pose
            self._node.log.info("the robot was at (%.2f, %.2f) before: %s", at.x, at.y, self._path)

    def _answer(self, _request: Message) -> dict[str, Any]:
        self._look()
        if self._kept is None or self._odometry is None:
            return {"known": False}
        limits = self._parameters
        pose, covariance = self._kept.moved_on(self._odometry, limits.odom_error, limits.least_error)
        self._node.log.info("the localization asks: the robot is at (%.2f, %.2f)", pose.x, pose.y)
        return {
            "known": True,
            "pose": {
                "header": {"stamp": self._node.now(), "frame_id": self._kept.frame},
                "pose": pose_with_covariance_fields(pose, covariance),
            },
        }


def _is_same(one: KeptPose, two: KeptPose) -> bool:
    return bool(
        np.allclose(one.pose.as_array(), two.pose.as_array(), rtol=0.0, atol=STILL)
        and np.allclose(one.odometry.as_array(), two.odometry.as_array(), rtol=0.0, atol=STILL)
    )


async def ask_for_last_pose(node: Node, timeout: float, waits: Callable[[str], bool]) -> Message | None:
    """Return where the robot was localized before this node was started again; None if that is not known.

    Args:
        node: The node that localizes the robot.
        timeout: Seconds to wait for the robot, which may be cut off from the cloud.
        waits: Called with the reason whenever the robot did not answer; returns whether to ask again.

    Returns:
        A ``geometry_msgs/PoseWithCovarianceStamped``.
    """
    client = node.service_client(SERVICE, TYPE)
    late = time.monotonic() + timeout
    try:
        while True:
            try:
                answer = await client.call({}, timeout=ANSWER_TIMEOUT)
            except RosError as error:
                if not waits(f"waiting for the robot's last pose: service {node.resolve(SERVICE)}: {error}"):
                    return None
                if time.monotonic() < late and await node.sleep(RETRY):
                    continue
                node.log.warning("no last pose in time: the initial pose of the parameters is used")
                return None
            return answer.pose if answer.known else None
    finally:
        await client.close()


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("pose_keeper") as node:
        await PoseKeeper(node, await read_parameters(node, PoseKeeperParameters)).run()


if __name__ == "__main__":
    run(main())
