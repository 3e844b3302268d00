"""Localizes a robot on a map: ROS 1's ``amcl``, its topics, services, parameters and frames.

The work is done by :mod:`rce_fleet.localization`; this node passes messages to it and from it.
http://wiki.ros.org/amcl documents what it takes and gives; ``docs/reference/amcl.md`` lists the differences.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.node import Message, Node, NodeClosedError, Publisher, RosError, Time, run
from rce.ros.tf import TransformBroadcaster, TransformError, TransformListener
from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.amcl import Amcl, Estimate
from rce_fleet.localization.parameters import LaserModel
from rce_fleet.localization.scan import LaserScan
from rce_fleet.nodes.amcl_frames import RobotFrames
from rce_fleet.nodes.amcl_parameters import UNUSED, AmclNodeParameters
from rce_fleet.nodes.amcl_pose_store import PoseStore
from rce_fleet.nodes.amcl_state import describe
from rce_fleet.nodes.diagnostics import Diagnostics
from rce_fleet.nodes.kept_pose import KeptPose
from rce_fleet.nodes.map_messages import read_scan
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import pose_fields, read_map
from rce_fleet.nodes.pose_keeper import ask_for_last_pose
from rce_fleet.nodes.pose_messages import pose_with_covariance_fields, read_pose_with_covariance
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from numpy.typing import NDArray


SCANS = 5
"""Scans that wait for their transforms; more are dropped, the oldest first."""
MAP_RETRY = 0.5
"""Seconds between two tries to get the map from its service."""
FIRST_SAVE = 0.1
"""Seconds between two looks for a first pose to store: the robot may drive away and the node die at once."""


@dataclass(frozen=True, slots=True)
class _Found:
    """The last result of the filter."""

    estimate: Estimate
    stamp: Time
    kept: KeptPose


class AmclNode:
    """The filter in a ROS graph.

    Args:
        node: A running node.
        parameters: Its parameters.
        seed: Of the filter's random numbers; None: a new one each time.
    """

    def __init__(self, node: Node, parameters: AmclNodeParameters, *, seed: int | None = None) -> None:
        self._node = node
        self._parameters = parameters
        self._rng = np.random.default_rng(seed)
        self._amcl: Amcl | None = None
        self._start: tuple[Pose, NDArray[np.float64]] | None = None
        self._found: _Found | None = None
        self._watch = OdometryWatch()
        self._store = PoseStore(node, parameters)
        self._throttled_log = ThrottledLog(node)
        self._fault = ""
        self._used_at: float | None = None
        self._scan_stamp = Time()
        self._cloud_due = True
        """Whether the particles were not published since they changed: there was no subscriber."""
        self._frames: RobotFrames
        self._poses: Publisher
        self._clouds: Publisher
        self._diagnostics: Diagnostics

    async def run(self) -> None:
        """Localize the robot until the node is stopped."""
        node, parameters = self._node, self._parameters
        if parameters.compiled or parameters.laser_model_type is LaserModel.BEAM:
            await asyncio.to_thread(compile_kernels)  # the master calls the node meanwhile
        self._poses = await node.advertise("amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", latch=True)
        self._clouds = await node.advertise("particlecloud", "geometry_msgs/PoseArray", latch=True)
        self._diagnostics = await Diagnostics.start(node, "localization")
        async with AsyncExitStack() as stack:
            listener = await stack.enter_async_context(TransformListener(node, prefix=""))
            broadcaster = await stack.enter_async_context(TransformBroadcaster(node, prefix=listener.prefix))
            self._frames = RobotFrames(parameters, listener, broadcaster)
            await node.advertise_service("global_localization", "std_srvs/Empty", self._scatter)
            await node.advertise_service("request_nomotion_update", "std_srvs/Empty", self._force)
            await node.advertise_service("set_map", "nav_msgs/SetMap", self._set_map)
            await node.subscribe(
                "initialpose", "geometry_msgs/PoseWithCovarianceStamped", self._take_initial_pose
            )
            if parameters.last_pose_timeout > 0:
                await self._ask_for_last_pose()
            tasks = await stack.enter_async_context(asyncio.TaskGroup())
            asking = None
            if parameters.use_map_topic:
                await node.subscribe("map", "nav_msgs/OccupancyGrid", self._take_published_map)
            else:
                asking = tasks.create_task(self._ask_for_map())
            await node.subscribe("scan", "sensor_msgs/LaserScan", self._take_scan, queue_size=SCANS)
            saving = tasks.create_task(self._save_poses())
            while await node.sleep(1.0):
                self._report()
                if self._cloud_due and self._clouds.connections and self._amcl is not None:
                    self._publish_cloud(node.now())
            for task in (asking, saving):
                if task is not None:
                    task.cancel()

    # The start

    async def _ask_for_last_pose(self) -> None:
        """Begin where the robot was localized before this node was started again, if that is known."""

        def waits(fault: str) -> bool:
            self._fault = fault
            self._throttled_log.warn("last pose", fault)
            self._report()
            return self._start is None  # else an initial pose came meanwhile

        found = await ask_for_last_pose(self._node, self._parameters.last_pose_timeout, waits)
        if found is not None and self._start is None:
            self._start_at(found)
        self._fault = ""

    # The map

    async def _ask_for_map(self) -> None:
        client = self._node.service_client("static_map", "nav_msgs/GetMap")
        while self._amcl is None:
            try:
                answer = await client.call({})
            except RosError as error:
                self._throttled_log.warn("map", f"waiting for the map: service static_map: {error}")
                await asyncio.sleep(MAP_RETRY)
                continue
            if not self._take_map(answer.map):
                await asyncio.sleep(MAP_RETRY)

    def _take_published_map(self, message: Message) -> None:
        if self._amcl is None or not self._parameters.first_map_only:
            self._take_map(message)

    def _take_map(self, message: Message) -> bool:
        """Use a map; return whether it can be used."""
        frame = message.header.frame_id.lstrip("/")
        if frame and not self._frames.is_map(frame):
            self._throttled_log.warn(
                "map frame",
                f"the map is in frame {frame!r}, and global_frame_id is {self._parameters.global_frame_id!r};"
                " its poses are used as they are",
            )
        try:
            grid = read_map(message)
            if self._amcl is None:
                self._amcl = Amcl(grid, self._parameters, self._rng)
                if self._start is not None:  # it came before the map
                    self._amcl.set_pose(*self._start)
            else:
                self._amcl.set_map(grid)
                self._amcl.request_update()
        except (MapError, ValueError) as error:
            self._throttled_log.warn("map", f"the map cannot be used: {error}")
            self._fault = f"the map cannot be used: {error}"
            return False
        self._fault, self._cloud_due = "", True
        self._node.log.info("map of %d x %d cells of %.3f m", grid.columns, grid.rows, grid.resolution)
        return True

    def _set_map(self, request: Message) -> dict[str, Any]:
        if not self._take_map(request.map):
            return {"success": False}
        return {"success": self._start_at(request.initial_pose)}

    # Poses from outside

    def _take_initial_pose(self, message: Message) -> None:
        self._start_at(message)

    def _start_at(self, message: Message) -> bool:
        frame = message.header.frame_id.lstrip("/")
        expected = self._parameters.global_frame_id
        if not self._frames.is_map(frame):
            if frame:
                self._node.log.error(
                    "initialpose is in frame %r, expected %r: ignored; set the fixed frame of rviz to %r",
                    frame,
                    expected,
                    expected,
                )
                return False
            self._node.log.warning("initialpose has no frame_id; %r is assumed", expected)
        try:
            pose, covariance = read_pose_with_covariance(message.pose)
        except ValueError as error:
            self._node.log.error("initialpose is ignored: %s", error)  # noqa: TRY400 - the sender's mistake
            return False
        pose = pose.compose(self._frames.moved_since(message.header.stamp))
        self._start = pose, covariance
        self._store.forget()
        if self._amcl is not None:
            self._amcl.set_pose(*self._start, self._frames.odometry_now())
        self._cloud_due = True
        self._node.log.info("initial pose (%.3f, %.3f, %.3f)", pose.x, pose.y, pose.yaw)
        return True

    def _scatter(self, _request: Message) -> dict[str, Any]:
        if self._amcl is None:
            self._node.log.warning("global_localization: there is no map yet")
        else:
            self._store.forget()
            self._amcl.scatter()
            self._node.log.info("global localization: particles on all free cells")
            self._publish_cloud(self._node.now())
        return {}

    def _force(self, _request: Message) -> dict[str, Any]:
        if self._amcl is not None:
            self._amcl.request_update()
        return {}

    # Scans

    async def _take_scan(self, message: Message) -> None:
        if self._amcl is None:
            return
        stamp, frame = message.header.stamp, message.header.frame_id
        if stamp and stamp < self._scan_stamp and self._node.now() >= self._scan_stamp:
            self._refuse(
                "scan", f"a scan is {_seconds(self._scan_stamp, stamp):.3f} s older than the last one"
            )
            return
        try:
            laser = await self._frames.laser(frame)
            scan = read_scan(message, laser)
            odometry = await self._frames.odometry(stamp)
        except (TransformError, TimeoutError) as error:
            late = self._node.time() - stamp.to_sec()
            when = f"{late:.2f} s old" if late >= 0 else f"{-late:.2f} s in the future"
            self._refuse("transform", f"a scan ({when}) cannot be used: {error}")
            return
        except ValueError as error:
            self._refuse("scan", f"a scan of frame {frame!r} cannot be used: {error}")
            return
        except NodeClosedError:  # the node was stopped while the scan waited
            return
        self._scan_stamp = stamp
        self._use(scan, odometry, stamp)

    def _refuse(self, subject: str, text: str) -> None:
        self._throttled_log.warn(subject, text)
        self._fault = text

    def _use(self, scan: LaserScan, odometry: Pose, stamp: Time) -> None:
        assert self._amcl is not None
        jump = self._watch.check(odometry, stamp.to_sec())
        if jump:
            self._throttled_log.warn("odometry", f"{jump}; the pose before it is kept")
            self._amcl.forget_odometry()
        stored = self._store.take(odometry, stamp.to_sec())
        if stored is not None:
            at = stored.pose
            self._amcl.set_pose(at, stored.covariance, odometry)
            self._node.log.info("the robot is at (%.3f, %.3f, %.3f) by its stored pose", at.x, at.y, at.yaw)
        estimate = self._amcl.update(odometry, scan)
        self._fault, self._used_at = "", self._node.time()
        if estimate is not None:
            kept = KeptPose(self._frames.map_frame, estimate.pose, estimate.covariance, odometry)
            self._found = _Found(estimate, stamp, kept)
            self._publish(self._found)
        if self._found is not None and self._parameters.tf_broadcast:
            self._frames.send(self._found.estimate.map_from_odom, stamp)

    # What goes out

    def _publish(self, found: _Found) -> None:
        estimate = found.estimate
        self._poses.publish(
            header={"stamp": found.stamp, "frame_id": self._frames.map_frame},
            pose=pose_with_covariance_fields(estimate.pose, estimate.covariance),
        )
        self._cloud_due = True
        if self._clouds.connections:
            self._publish_cloud(found.stamp)

    def _publish_cloud(self, stamp: Time) -> None:
        assert self._amcl is not None
        self._cloud_due = False
        self._clouds.publish(
            header={"stamp": stamp, "frame_id": self._frames.map_frame},
            poses=[pose_fields(Pose.from_array(each)) for each in self._amcl.particles],
        )

    # Its state

    def _report(self) -> None:
        state = describe(
            self._parameters,
            particles=None if self._amcl is None else len(self._amcl.weights),
            scan_age=None if self._used_at is None else self._node.time() - self._used_at,
            fault=self._fault,
            estimate=None if self._found is None else self._found.estimate,
        )
        self._diagnostics.publish(*state)

    async def _save_poses(self) -> None:
        """Store the pose where a restarted node finds it."""
        rate = self._parameters.save_pose_rate
        while rate > 0 and await self._node.sleep(FIRST_SAVE if self._found is None else 1 / rate):
            if self._found is None:
                continue
            try:
                await self._store.save(self._found.kept, self._found.stamp.to_sec())
            except RosError as error:
                self._throttled_log.warn("save", f"the pose cannot be stored in the parameters: {error}")


def _seconds(later: Time, earlier: Time) -> float:
    return later.to_sec() - earlier.to_sec()


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("amcl") as node:
        await AmclNode(node, await read_parameters(node, AmclNodeParameters, unused=UNUSED)).run()


if __name__ == "__main__":
    run(main())
