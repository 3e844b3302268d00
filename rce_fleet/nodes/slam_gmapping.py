"""Makes a map while a robot drives: ROS 1's ``gmapping slam_gmapping``.

The work is done by :mod:`rce_fleet.mapping.gmapping`, in a thread; this node passes messages.
http://wiki.ros.org/gmapping documents topics, service and parameters; ``docs/reference/mapping.md`` lists the
differences.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.node import Message, Node, Publisher, ServiceFaultError, Time, run
from rce.ros.tf import (
    StampedTransform,
    Transform,
    TransformBroadcaster,
    TransformError,
    TransformListener,
)
from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose
from rce_fleet.mapping.gmapping.filter import GridFilter
from rce_fleet.mapping.gmapping.parameters import FilterParameters
from rce_fleet.mapping.occupancy_mapping import map_of
from rce_fleet.mapping.records import LaserRecord
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.map_messages import map_fields
from rce_fleet.nodes.mapped_robot import scan_record
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import pose_of
from rce_fleet.nodes.pose_messages import pose_with_covariance_fields
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from rce_fleet.maps.occupancy_map import OccupancyMap

UNUSED = ("inverted_laser", "xmin", "ymin", "xmax", "ymax")
"""The laser's transform says whether it is upside down; the map is as large as what was seen."""
SCANS = 5
"""Scans that wait for their transforms or for the filter; more are dropped, the oldest first."""
WAIT = 0.5
"""Seconds that a scan waits for its transforms."""
REPORT_S = 1.0
QUIET_S = 5.0
"""Seconds without a scan after which the state is a warning."""


@dataclass(frozen=True)
class SlamGmappingParameters(FilterParameters):
    """Parameters of the node: those of the filter, and these.

    Attributes:
        base_frame: Frame of the robot's base.
        map_frame: Frame of the map.
        odom_frame: Frame of the odometry.
        map_update_interval: Seconds between two published maps.
        transform_publish_period: Seconds between two transforms; 0: none.
        tf_delay: Seconds by which transforms are dated ahead; below 0: transform_publish_period.
        throttle_scans: Every so many scans one is used.
        seed: Of the filter's random numbers; below 0: another one each time.
        map_start_pose: Where the robot is on the map at the first scan: x, y (metres), yaw (radians); named
            as in slam_toolbox.
    """

    base_frame: str = "base_link"
    map_frame: str = "map"
    odom_frame: str = "odom"
    map_update_interval: float = field(default=5.0, metadata={"minimum": 0})
    transform_publish_period: float = field(default=0.05, metadata={"minimum": 0})
    tf_delay: float = -1.0
    throttle_scans: int = field(default=1, metadata={"minimum": 1})
    seed: int = -1
    map_start_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)


class SlamGmappingNode:
    """The filter in a ROS graph.

    Args:
        node: A running node.
        parameters: Its parameters.
    """

    def __init__(self, node: Node, parameters: SlamGmappingParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._filter = GridFilter(
            parameters,
            np.random.default_rng(None if parameters.seed < 0 else parameters.seed),
            parameters.map_start_pose,
            keeps_way=False,
        )
        self._watch = OdometryWatch()
        self._throttled_log = ThrottledLog(node)
        self._fault = ""
        self._count = 0
        self._stamp = Time()
        self._used_at = -inf
        self._map_from_odom: Pose | None = None
        self._map: OccupancyMap | None = None
        self._published: OccupancyMap | None = None
        self._map_at = -inf
        self._lasers: dict[str, Transform] = {}
        self._listener: TransformListener
        self._poses: Publisher
        self._maps: Publisher
        self._metadata: Publisher
        self._entropies: Publisher

    async def run(self) -> None:
        """Make a map until the node is stopped."""
        node = self._node
        await asyncio.to_thread(compile_kernels)
        self._poses = await node.advertise("pose", "geometry_msgs/PoseWithCovarianceStamped", latch=True)
        self._maps = await node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        self._metadata = await node.advertise("map_metadata", "nav_msgs/MapMetaData", latch=True)
        self._entropies = await node.advertise("~entropy", "std_msgs/Float64", latch=True)
        diagnostics = await Diagnostics.start(node, "mapping")
        async with AsyncExitStack() as stack:
            self._listener = await stack.enter_async_context(TransformListener(node, prefix=""))
            broadcaster = await stack.enter_async_context(
                TransformBroadcaster(node, prefix=self._listener.prefix)
            )
            await node.advertise_service("dynamic_map", "nav_msgs/GetMap", self._give)
            await node.subscribe("scan", "sensor_msgs/LaserScan", self._take_scan, queue_size=SCANS)
            tasks = await stack.enter_async_context(asyncio.TaskGroup())
            sending = tasks.create_task(self._send_transforms(broadcaster))
            while await node.sleep(REPORT_S):
                diagnostics.publish(*self._state())
            sending.cancel()

    # Scans

    async def _take_scan(self, message: Message) -> None:
        self._count += 1
        if (self._count - 1) % self._parameters.throttle_scans:
            return
        stamp, frame = message.header.stamp, message.header.frame_id
        if stamp < self._stamp and self._node.now() >= self._stamp:
            late = self._stamp.to_sec() - stamp.to_sec()
            self._refuse("old scan", f"a scan is {late:.3f} s older than the last one and is left out")
            return
        try:
            record = await self._read(message)
        except (TransformError, TimeoutError) as error:
            late = self._node.time() - stamp.to_sec()
            when = f"{late:.2f} s old" if late >= 0 else f"{-late:.2f} s in the future"
            self._refuse("transform", f"a scan ({when}) cannot be used: {error}")
            return
        except ValueError as error:
            self._refuse("scan", f"a scan of frame {frame!r} cannot be used: {error}")
            return
        self._stamp = stamp
        try:
            updated = await asyncio.to_thread(self._use, record)
        except MapError as error:
            self._refuse("map", f"a scan cannot be drawn: {error}")
            return
        self._fault, self._used_at = "", self._node.time()
        self._publish_pose(stamp)
        if updated:
            self._publish(stamp)

    async def _read(self, message: Message) -> LaserRecord:
        """Return a scan with the odometry at its time."""
        parameters, stamp, frame = self._parameters, message.header.stamp, message.header.frame_id
        if frame not in self._lasers:
            found = await self._listener.wait_for(
                parameters.base_frame, f"/{frame.lstrip('/')}", timeout=WAIT
            )
            self._lasers[frame] = found.transform
        moved = await self._listener.wait_for(
            parameters.odom_frame, parameters.base_frame, stamp, timeout=WAIT
        )
        pose = pose_of(moved.transform)
        record = scan_record(message, self._lasers[frame], pose, self._count - 1)
        jump = self._watch.check(pose, stamp.to_sec())
        if jump:
            self._throttled_log.warn("odometry", f"{jump}; the pose before it is kept")
            self._filter.forget_odometry()
        return record

    def _use(self, record: LaserRecord) -> bool:
        """Use a scan, in a thread; return whether there is a new map or pose of the particles."""
        updated = self._filter.add(record)
        estimate = Pose.from_array(self._filter.estimate)
        self._map_from_odom = estimate.compose(Pose(*record.odometry).inverse())
        now = self._node.time()
        is_young = 0 <= now - self._map_at < self._parameters.map_update_interval
        if updated and (self._map is None or not is_young):
            self._map_at = now
            self._map = map_of(self._filter.store, self._filter.best, self._parameters.occupied_threshold)
        return updated

    def _refuse(self, subject: str, text: str) -> None:
        self._throttled_log.warn(subject, text)
        self._fault = text

    # What goes out

    def _publish_pose(self, stamp: Time) -> None:
        """Publish where the robot was at a scan, and how far the particles are apart."""
        found = self._filter
        frame = self._listener.resolve(self._parameters.map_frame)
        pose = pose_with_covariance_fields(Pose.from_array(found.estimate), found.covariance)
        self._poses.publish(header={"stamp": stamp, "frame_id": frame}, pose=pose)

    def _publish(self, stamp: Time) -> None:
        self._entropies.publish(data=self._filter.entropy)
        if self._map is not None and self._published is not self._map:
            self._published = self._map
            fields = self._fields(self._map, stamp)
            self._maps.publish(**fields)
            self._metadata.publish(**fields["info"])

    def _fields(self, drawn: OccupancyMap, stamp: Time) -> dict[str, Any]:
        return map_fields(drawn, self._listener.resolve(self._parameters.map_frame), stamp)

    def _give(self, _request: Message) -> dict[str, Any]:
        if self._map is None:
            raise ServiceFaultError(
                self._node.resolve("dynamic_map"), "there is no map yet: no scan has been used"
            )
        return {"map": self._fields(self._map, self._node.now())}

    async def _send_transforms(self, broadcaster: TransformBroadcaster) -> None:
        parameters = self._parameters
        period = parameters.transform_publish_period
        delay = period if parameters.tf_delay < 0 else parameters.tf_delay
        while period > 0 and await self._node.sleep(period):
            pose = self._map_from_odom
            if pose is not None:
                until = Time.from_sec(self._node.time() + delay)
                transform = Transform.make(pose.x, pose.y, yaw=pose.yaw)
                broadcaster.send_stamped(
                    StampedTransform(parameters.map_frame, parameters.odom_frame, transform, until)
                )

    def _state(self) -> tuple[Level, str, dict[str, str]]:
        """Return level, text and values of the node's state."""
        values = {
            "scans": str(self._count),
            "effective particles": f"{self._filter.effective:.1f}",
            "tiles": str(self._filter.store.tiles),
        }
        age = self._node.time() - self._used_at
        if self._fault:
            return Level.WARN, self._fault, values
        if age == inf:
            return Level.WARN, "no scan yet", values
        if age > QUIET_S:
            return Level.WARN, f"no usable scan for {age:.0f} s", values
        return Level.OK, "mapping", values


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("slam_gmapping") as node:
        parameters = await read_parameters(node, SlamGmappingParameters, unused=UNUSED)
        await SlamGmappingNode(node, parameters).run()


if __name__ == "__main__":
    run(main())
