"""Reads laser scans and odometry from ROS 1 bags."""

from __future__ import annotations

import bisect
import struct
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from math import atan2, hypot, inf, isfinite, isnan
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rce_fleet.exceptions import LogError
from rce_fleet.geometry.angles import difference, wrap
from rce_fleet.geometry.poses import Pose
from rce_fleet.mapping.records import LaserRecord, ScanLog

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
TRANSFORM_TOPICS = ("/tf_static", "/tf")
BACKWARDS_S = 1.0
MAX_FAULTS = 100
_DAMAGED = (
    *(ReaderError, SerdeError, struct.error),
    *(AssertionError, EOFError, LookupError, MemoryError, OSError, OverflowError, RuntimeError, ValueError),
)
"""What the library raises where a file is damaged."""


@dataclass(frozen=True, slots=True)
class _Mount:
    """A frame in its parent: its origin there, shape (3,), and its rotation, shape (3, 3)."""

    parent: str
    at: NDArray[np.float64]
    turn: NDArray[np.float64]


@dataclass(slots=True)
class _Contents:
    scans: list[tuple[float, Any]] = field(default_factory=list)
    odometry: list[tuple[float, Pose]] = field(default_factory=list)
    transforms: dict[str, _Mount] = field(default_factory=dict)
    """Frames by their names."""
    base: str = ""
    faults: list[str] = field(default_factory=list)


def read_bag(path: Path, *, scan: str = "/scan", odometry: str = "/odom") -> ScanLog:
    """Read the scans of a bag, each with the odometry at its time.

    Odometry is interpolated between the messages around a scan. The laser's pose on the base comes from
    ``/tf_static`` or ``/tf``, and it may be upside down; without transforms the laser is at the base.
    Messages that cannot be used, and what follows damage of the file, are left out and listed in ``faults``
    of the result.

    Args:
        path: The bag.
        scan: Topic of ``sensor_msgs/LaserScan``.
        odometry: Topic of ``nav_msgs/Odometry``.

    Raises:
        LogError: The bag cannot be read, or has no messages of these types on these topics.
    """
    try:
        reader = Reader(path)
        reader.open()
    except _DAMAGED as error:
        raise LogError(f"{path}: cannot be read as a ROS 1 bag: {_words(error)}") from error
    with closing(reader):
        _check_topic(reader, path, scan, SCAN_TYPE, "--scan")
        _check_topic(reader, path, odometry, ODOMETRY_TYPE, "--odom")
        contents = _read(reader, path, scan, odometry)
    if not contents.scans or not contents.odometry:
        empty = scan if not contents.scans else odometry
        raise LogError(f"{path}: the topic {empty} has no usable message")
    return ScanLog(str(path), _records(contents, path), contents.faults)


def typestore() -> Typestore:
    """Return ROS 1's message types and those of transforms."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORM_TYPES[0]))
    return store


def _check_topic(reader: Reader, path: Path, topic: str, expected: str, option: str) -> None:
    found = {connection.topic: connection.msgtype for connection in reader.connections}
    if found.get(topic) == expected:
        return
    name = expected.replace("/msg/", "/")
    fitting = ", ".join(sorted(each for each, kind in found.items() if kind == expected)) or "none"
    problem = (
        f"the topic {topic} has messages of type {found[topic].replace('/msg/', '/')}"
        if topic in found
        else (f"there is no topic {topic}")
    )
    raise LogError(
        f"{path}: {problem}; expected {name}. Topics of this type: {fitting}; choose one with {option}"
    )


def _read(reader: Reader, path: Path, scan: str, odometry: str) -> _Contents:
    contents = _Contents()
    store = typestore()
    wanted = [
        each
        for each in reader.connections
        if each.topic in {scan, odometry}
        or (each.topic in TRANSFORM_TOPICS and each.msgtype in TRANSFORM_TYPES)
    ]
    for connection, _, raw in _messages(reader, path, wanted, contents):
        try:
            kind = TRANSFORM_TYPES[0] if connection.msgtype in TRANSFORM_TYPES else connection.msgtype
            message: Any = store.deserialize_ros1(raw, kind)
        except _DAMAGED as error:
            _fault(contents, f"{path}: a message on {connection.topic} cannot be read: {_words(error)}")
            continue
        if connection.topic == scan:
            _take_scan(contents, path, message)
        elif connection.topic == odometry:
            _take_odometry(contents, path, message)
        else:
            _take_transforms(contents, path, message, is_static=connection.topic == "/tf_static")
    return contents


def _fault(contents: _Contents, text: str) -> None:
    if len(contents.faults) < MAX_FAULTS:
        contents.faults.append(text)


def _messages(
    reader: Reader, path: Path, wanted: Sequence[Connection], contents: _Contents
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield messages as far as the file is not damaged."""
    try:
        yield from reader.messages(connections=wanted)
    except _DAMAGED as error:
        contents.faults.append(f"{path}: the bag is damaged, and the rest is left out: {_words(error)}")


def _words(error: BaseException) -> str:
    return str(error) or type(error).__name__


def _take_scan(contents: _Contents, path: Path, message: Any) -> None:
    stamp = _seconds(message.header.stamp)
    if not all(map(isfinite, (message.angle_min, message.angle_increment))) or isnan(message.range_max):
        _fault(
            contents, f"{path}: the angles or limits of the scan at {stamp:.3f} s are not finite; left out"
        )
        return
    if message.angle_increment == 0:
        _fault(contents, f"{path}: angle_increment of the scan at {stamp:.3f} s is 0; left out")
        return
    contents.scans.append((stamp, message))


def _take_odometry(contents: _Contents, path: Path, message: Any) -> None:
    pose = _pose(message.pose.pose.position, message.pose.pose.orientation)
    stamp = _seconds(message.header.stamp)
    if not all(map(isfinite, (pose.x, pose.y, pose.yaw))):
        _fault(contents, f"{path}: odometry at {stamp:.3f} s is not finite; left out")
        return
    contents.base = contents.base or message.child_frame_id.strip("/")
    contents.odometry.append((stamp, pose))


def _take_transforms(contents: _Contents, path: Path, message: Any, *, is_static: bool) -> None:
    for each in message.transforms:
        child = each.child_frame_id.strip("/")
        at, turn = each.transform.translation, _rotation(each.transform.rotation)
        mount = _Mount(each.header.frame_id.strip("/"), np.array((at.x, at.y, at.z), np.float64), turn)
        if not (np.isfinite(mount.at).all() and np.isfinite(mount.turn).all()):
            _fault(contents, f"{path}: a transform to {child!r} is not finite; left out")
            continue
        if is_static or child not in contents.transforms:
            contents.transforms[child] = mount


def _records(contents: _Contents, path: Path) -> list[LaserRecord]:
    contents.odometry.sort(key=lambda each: each[0])
    times = [stamp for stamp, _ in contents.odometry]
    records: list[LaserRecord] = []
    for before, after in pairwise(contents.scans):
        if after[0] < before[0] - BACKWARDS_S:
            _fault(contents, f"{path}: the scan at {after[0]:.3f} s follows one at {before[0]:.3f} s")
    lasers: dict[str, tuple[Pose, float]] = {}
    for stamp, message in contents.scans:
        frame = message.header.frame_id.strip("/")
        if frame not in lasers:
            lasers[frame] = _laser(contents, path, frame)
        laser, side = lasers[frame]
        pose = _odometry_at(contents.odometry, times, stamp)
        ranges = np.asarray(message.ranges, np.float64)
        with np.errstate(invalid="ignore"):
            seen = (ranges >= message.range_min) & (ranges < message.range_max)
        records.append(
            LaserRecord(
                index=len(records),
                time=stamp,
                ranges=np.where(seen, ranges, inf),
                angle_min=side * float(message.angle_min),
                angle_increment=side * float(message.angle_increment),
                range_max=float(message.range_max),
                odometry=(pose.x, pose.y, pose.yaw),
                laser=(laser.x, laser.y, laser.yaw),
            )
        )
    return records


def _laser(contents: _Contents, path: Path, frame: str) -> tuple[Pose, float]:
    """Return the pose of the laser's frame on the base, and -1 if it is upside down, else 1.

    The frames between them are followed.
    """
    at, place, turn = frame, np.zeros(3), np.eye(3)
    for _ in range(len(contents.transforms) + 1):
        if at == contents.base or at not in contents.transforms:
            break
        mount = contents.transforms[at]
        at, place, turn = mount.parent, mount.at + mount.turn @ place, mount.turn @ turn
    if at == contents.base or not contents.transforms:
        yaw = atan2(turn[1, 0], turn[0, 0])
        return Pose(float(place[0]), float(place[1]), yaw), -1.0 if turn[2, 2] < 0 else 1.0
    _fault(
        contents,
        f"{path}: no transform from {contents.base!r} to {frame!r}; the laser is taken to be at the base",
    )
    return Pose(0.0, 0.0, 0.0), 1.0


def _odometry_at(odometry: Sequence[tuple[float, Pose]], times: Sequence[float], stamp: float) -> Pose:
    after = bisect.bisect_left(times, stamp)
    if after == 0:
        return odometry[0][1]
    if after == len(times):
        return odometry[-1][1]
    (start, first), (end, second) = odometry[after - 1], odometry[after]
    share = (stamp - start) / (end - start) if end > start else 0.0
    return Pose(
        first.x + share * (second.x - first.x),
        first.y + share * (second.y - first.y),
        wrap(first.yaw + share * difference(second.yaw, first.yaw)),
    )


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec * 1e-9)


def _pose(position: Any, turn: Any) -> Pose:
    yaw = atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y * turn.y + turn.z * turn.z))
    return Pose(float(position.x), float(position.y), yaw)


def _rotation(turn: Any) -> NDArray[np.float64]:
    """Return the matrix of a quaternion, shape (3, 3); of one without a length, no rotation."""
    values = (turn.x, turn.y, turn.z, turn.w)
    length = hypot(*values)
    if not length:
        return np.eye(3)
    x, y, z, w = (value / length for value in values)
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )
