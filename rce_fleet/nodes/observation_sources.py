"""Brings scans and point clouds into a costmap, at the place that tf gives for their time."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.tf import ExtrapolationError, Transform, TransformError, TransformListener
from rce_fleet.navigation.costmap.observation import Observation, observe_points, observe_scan
from rce_fleet.navigation.scans import fault_of_scan, fault_of_stamp
from rce_fleet.nodes.planar import angles_from_above, pose_of
from rce_fleet.nodes.robot_place import full_name, named_in_message

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rce.ros.node import Node
    from rce.ros.types import Message, Time
    from rce_fleet.navigation.costmap.layered import LayeredCostmap
    from rce_fleet.navigation.costmap.parameters import ObservationSource
    from rce_fleet.nodes.throttled_log import ThrottledLog

TYPES = {
    "LaserScan": "sensor_msgs/LaserScan",
    "PointCloud": "sensor_msgs/PointCloud",
    "PointCloud2": "sensor_msgs/PointCloud2",
}
OLDEST = 2.0
"""Messages older than this are of no use, seconds: the network is too slow, or a clock is wrong."""
WAITING = 10
"""How many messages of a source wait for their transform."""
_FLOAT32, _FLOAT64 = 7, 8
"""Types of fields of a ``sensor_msgs/PointCloud2``."""


class ObservationSources:
    """Subscribes to the sensors of a costmap.

    A message waits until tf knows the sensor's place at its time.

    Args:
        node: Running node.
        transforms: What is known of frames.
        costmap: The costmap, with an obstacle layer.
        throttled_log: Where warnings go.

    Attributes:
        newest: Time stamp of the newest message that was used; None before the first.
    """

    def __init__(
        self, node: Node, transforms: TransformListener, costmap: LayeredCostmap, throttled_log: ThrottledLog
    ) -> None:
        self._node = node
        self._transforms = transforms
        self._costmap = costmap
        self._throttled_log = throttled_log
        self._waiting: dict[str, deque[Message]] = {}
        self._faults: dict[str, str] = {}
        """What was wrong with the last message of a source."""
        self._used_at: dict[str, float] = {}
        """When a message of a source was used last, seconds."""
        self.newest: Time | None = None

    async def start(self) -> None:
        """Subscribe to the topics of all sources."""
        for name, source in self._costmap.parameters.sources.items():
            kind = TYPES.get(source.data_type)
            if kind is None:
                self._node.log.error(
                    "source %s is ignored: data_type must be one of %s, not %s",
                    name,
                    ", ".join(TYPES),
                    source.data_type,
                )
                continue
            self._waiting[name] = deque(maxlen=WAITING)
            await self._node.subscribe(source.topic or name, kind, partial(self._take, name))

    def _take(self, name: str, message: Message) -> None:
        self._waiting[name].append(message)

    def flush(self) -> None:
        """Give the costmap all messages whose sensor's place is known now."""
        now = self._node.time()
        for name, waiting in self._waiting.items():
            while waiting:
                done = self._try(name, waiting[0], now)
                if not done:
                    break
                waiting.popleft()

    def refused(self, now: float) -> list[str]:
        """Return the sources whose last message was of no use, and all others lately too.

        Args:
            now: Seconds.
        """
        return [
            name for name in self._faults if not 0 <= now - self._used_at.get(name, float("-inf")) <= OLDEST
        ]

    def faults_of(self, names: Iterable[str]) -> list[str]:
        """Return what was wrong with the last messages of these sources."""
        return [self._faults[name] for name in names if name in self._faults]

    def _try(self, name: str, message: Message, now: float) -> bool:
        """Use a message; return whether it need not wait any more."""
        source = self._costmap.parameters.sources[name]
        stamp = message.header.stamp
        fault = _fault(message, source, now)
        if not fault:
            own = source.sensor_frame
            frame = full_name(self._transforms, own) if own else named_in_message(message.header.frame_id)
            target = full_name(self._transforms, self._costmap.parameters.global_frame)
            try:
                found = self._transforms.lookup(target, frame, stamp or None)
                seen = _observe(message, source, found.transform, stamp.to_sec() if stamp else now)
                if self._costmap.obstacles is not None:
                    self._costmap.obstacles.take(name, seen)
                self._faults.pop(name, None)
                self._used_at[name] = now
                if self.newest is None or stamp > self.newest:
                    self.newest = stamp
            except ExtrapolationError as error:
                if error.is_future:
                    return False
                fault = str(error)
            except TransformError as error:
                self._faults[name] = f"it waits for its transform: {error}"
                self._throttled_log.warn(f"source {name}", f"source {name} waits for its transform: {error}")
                return False
            except ValueError as error:
                fault = str(error)
        if fault:
            self._faults[name] = f"the last one is ignored: {fault}"
            self._throttled_log.warn(f"source {name}", f"a message of source {name} is ignored: {fault}")
        return True


def _fault(message: Message, source: ObservationSource, now: float) -> str:
    """Return what is wrong with a message; empty if nothing is."""
    stamp = message.header.stamp
    fault = fault_of_stamp(stamp.to_sec(), now, OLDEST) if stamp else ""
    if not fault and source.data_type == "LaserScan":
        angles = (message.angle_min, message.angle_max, message.angle_increment)
        fault = fault_of_scan(len(message.ranges), angles, (message.range_min, message.range_max))
    return fault


def _observe(message: Message, source: ObservationSource, at: Transform, stamp: float) -> Observation:
    sensor = pose_of(at)
    if source.data_type == "LaserScan":
        return observe_scan(
            np.asarray(message.ranges, np.float64),
            *angles_from_above(at, message.angle_min, message.angle_increment),
            (message.range_min, message.range_max),
            sensor,
            source,
            stamp,
        )
    if source.data_type == "PointCloud":
        points = np.array([(p.x, p.y, p.z) for p in message.points], np.float64).reshape(-1, 3)
    else:
        points = points_of_cloud(message)
    matrix = np.array(at.matrix())
    return observe_points(points @ matrix[:3, :3].T + matrix[:3, 3], sensor, source, stamp)


def points_of_cloud(message: Message) -> NDArray[np.float64]:
    """Return the points of a ``sensor_msgs/PointCloud2``, shape (N, 3), in the frame of its sensor.

    Raises:
        ValueError: It has no fields x, y and z of floating point numbers.
    """
    kinds = {_FLOAT32: "f4", _FLOAT64: "f8"}
    order = ">" if message.is_bigendian else "<"
    fields = {one.name: one for one in message.fields}
    names, formats, offsets = ["x", "y", "z"], [], []
    for name in names:
        one = fields.get(name)
        if one is None or one.datatype not in kinds:
            raise ValueError("a point cloud needs the fields x, y and z as floating point numbers")
        formats.append(order + kinds[one.datatype])
        offsets.append(one.offset)
    layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    rows = np.frombuffer(bytes(message.data), np.uint8)[: message.height * message.row_step]
    rows = rows.reshape(message.height, message.row_step)[:, : message.width * message.point_step]
    table = np.frombuffer(rows.tobytes(), np.dtype(layout))
    return np.stack([table[name].astype(np.float64) for name in names], axis=1)
