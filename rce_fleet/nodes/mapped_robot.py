"""One robot of a mapping node: its scans with the odometry at their time."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce.ros.tf import Transform, TransformError, TransformListener
from rce_fleet.geometry.poses import Pose
from rce_fleet.mapping.records import LaserRecord
from rce_fleet.nodes.map_messages import read_scan
from rce_fleet.nodes.planar import pose_of, read_pose

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.node import Node
    from rce.ros.types import Message, Time
    from rce_fleet.nodes.slam_graph_parameters import SlamGraphParameters
    from rce_fleet.nodes.throttled_log import ThrottledLog

WAIT = 0.5
"""Seconds that a scan waits for its transforms."""
LEAST_RANGE = 1e-3
KEPT_ODOMETRY = 200
MOST_APART = 0.5
"""A scan needs odometry this near in time, seconds."""
SCANS = 10


class MappedRobot:
    """Reads one robot's scans and odometry, and hands them on.

    Args:
        node: The running node.
        name: Namespace of the robot; empty for that of the node.
        parameters: The node's parameters.
        listener: Hears transforms.
        throttled_log: Takes what is wrong with scans.
        take: Called with the robot's name and each usable scan.

    Attributes:
        name: Namespace of the robot; empty for that of the node.
        odom_frame: Name of its odometry frame.
        fault: Why the last scan could not be used; empty if it could.
        stamp: Time of the last usable scan.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        parameters: SlamGraphParameters,
        listener: TransformListener,
        throttled_log: ThrottledLog,
        take: Callable[[str, LaserRecord], None],
    ) -> None:
        self.name = name
        self.fault = ""
        self.stamp: Time | None = None
        self._node = node
        self._parameters = parameters
        self._listener = listener
        self._throttled_log = throttled_log
        self._take = take
        prefix = f"{name.strip('/')}/" if name else ""
        self.odom_frame = prefix + parameters.odom_frame
        self._base_frame = prefix + parameters.base_frame
        self._lasers: dict[str, Transform] = {}
        self._odometry: deque[tuple[float, Pose]] = deque(maxlen=KEPT_ODOMETRY)
        self._news = asyncio.Event()
        self._count = 0

    async def start(self) -> None:
        """Subscribe."""
        prefix = f"/{self.name.strip('/')}/" if self.name else ""
        if self._parameters.use_odom_topic:
            await self._node.subscribe(f"{prefix}odom", "nav_msgs/Odometry", self._take_odometry)
        await self._node.subscribe(
            f"{prefix}scan", "sensor_msgs/LaserScan", self._take_scan, queue_size=SCANS
        )

    def _take_odometry(self, message: Message) -> None:
        try:
            pose = read_pose(message.pose.pose)
        except ValueError as error:
            self._refuse("odometry", f"odometry cannot be used: {error}")
            return
        moment = message.header.stamp.to_sec()
        if self._odometry and moment < self._odometry[-1][0]:
            self._odometry.clear()  # a simulation or a bag began anew
        self._odometry.append((moment, pose))
        self._news.set()

    async def _take_scan(self, message: Message) -> None:
        self._count += 1
        if (self._count - 1) % self._parameters.throttle_scans:
            return
        stamp, frame = message.header.stamp, message.header.frame_id
        if self.stamp is not None and stamp < self.stamp and self._node.now() >= self.stamp:
            late = self.stamp.to_sec() - stamp.to_sec()
            self._refuse("scan", f"a scan is {late:.3f} s older than the last one and is left out")
            return
        try:
            laser = await self._laser(frame)
            odometry = await self._odometry_at(stamp)
            record = scan_record(message, laser, odometry, self._count - 1)
        except (TransformError, TimeoutError) as error:
            late = self._node.time() - stamp.to_sec()
            when = f"{late:.2f} s old" if late >= 0 else f"{-late:.2f} s in the future"
            self._refuse("transform", f"a scan ({when}) cannot be used: {error}")
        except ValueError as error:
            self._refuse("scan", f"a scan of frame {frame!r} cannot be used: {error}")
        else:
            self.stamp, self.fault = stamp, ""
            self._take(self.name, record)

    def _refuse(self, subject: str, text: str) -> None:
        self.fault = text
        self._throttled_log.warn(f"{self.name} {subject}", f"{self.name}: {text}" if self.name else text)

    async def _laser(self, frame: str) -> Transform:
        """Return ``base_from_laser``, which never changes."""
        if self._parameters.use_odom_topic:
            x, y, yaw = self._parameters.laser_pose
            return Transform.make(x, y, yaw=yaw)
        if frame not in self._lasers:
            found = await self._listener.wait_for(self._base_frame, f"/{frame.lstrip('/')}", timeout=WAIT)
            self._lasers[frame] = found.transform
        return self._lasers[frame]

    async def _odometry_at(self, stamp: Time) -> Pose:
        if self._parameters.use_odom_topic:
            await self._wait_for_odometry(stamp.to_sec())
            return self._nearest_odometry(stamp.to_sec())
        found = await self._listener.wait_for(self.odom_frame, self._base_frame, stamp, timeout=WAIT)
        return pose_of(found.transform)

    async def _wait_for_odometry(self, moment: float) -> None:
        """Wait a little for odometry of a time: it comes on a connection of its own, and may be later."""
        with suppress(TimeoutError):
            async with asyncio.timeout(WAIT):
                while not self._odometry or self._odometry[-1][0] < moment:
                    self._news.clear()
                    await self._news.wait()

    def _nearest_odometry(self, moment: float) -> Pose:
        """Return the odometry at a time: between two messages, or that of the nearest one.

        Raises:
            ValueError: There is none near that time.
        """
        before = [each for each in self._odometry if each[0] <= moment]
        after = [each for each in self._odometry if each[0] > moment]
        if before and after:
            (start, first), (end, second) = before[-1], after[0]
            share = (moment - start) / (end - start)
            step = second.relative_to(first)
            return first.compose(Pose(share * step.x, share * step.y, share * step.yaw))
        nearest = before[-1] if before else after[0] if after else None
        if nearest is None or abs(nearest[0] - moment) > MOST_APART:
            raise ValueError(f"there is no odometry within {MOST_APART} s of its time on the topic odom")
        return nearest[1]


def scan_record(message: Message, base_from_laser: Transform, odometry: Pose, index: int) -> LaserRecord:
    """Return a ``sensor_msgs/LaserScan`` as mappers take it. The laser may be upside down.

    Args:
        message: The scan.
        base_from_laser: Where the laser is on the base.
        odometry: Odometry at its time.
        index: Number of the scan.

    Raises:
        ValueError: Its angles, limits or length are not those of a scan; the text says what is expected.
    """
    scan = read_scan(message, base_from_laser)
    with np.errstate(invalid="ignore"):
        usable = (scan.ranges >= max(scan.range_min, LEAST_RANGE)) & (scan.ranges < scan.range_max)
    return LaserRecord(
        index=index,
        time=message.header.stamp.to_sec(),
        ranges=np.where(usable, scan.ranges, inf),
        angle_min=scan.angle_min,
        angle_increment=scan.angle_increment,
        range_max=scan.range_max,
        odometry=(odometry.x, odometry.y, odometry.yaw),
        laser=(scan.laser.x, scan.laser.y, scan.laser.yaw),
    )
