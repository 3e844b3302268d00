"""A drive of a robot with a laser and drifting odometry through two rooms, as records, logs and bags."""

from __future__ import annotations

from itertools import pairwise
from math import cos, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer

from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.records import LaserRecord
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ray_casting import cast_rays
from rce_fleet.offline.bags import typestore

BEAMS = 90
START = np.array((4.7, 3.2, -np.pi / 2))
"""True pose at the first scan, in the map of the rooms."""
FRONT = np.array((0.1, 0.0, 0.0))
"""Where the laser is on the base of a bag's robot."""


def rooms() -> OccupancyMap:
    """Return two rooms with a door, without symmetry, 6 m x 4 m."""
    cells = np.zeros((80, 120), np.int8)
    cells[[0, -1], :] = 100
    cells[:, [0, -1]] = 100
    cells[:50, 60] = 100
    cells[20:26, 90:96] = 100
    return OccupancyMap(cells, 0.05)


def drive(
    number: int = 60, *, laser: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], list[LaserRecord]]:
    """Return the true poses, seen from the first one, and what the robot records."""
    turns = np.linspace(0, 2 * np.pi, number)
    yaws = np.unwrap(np.arctan2(-np.cos(2 * turns), -1.7 * np.sin(turns)))
    true = np.column_stack((3 + 1.7 * np.cos(turns), 3.2 - 0.5 * np.sin(2 * turns), yaws))
    draw = np.random.default_rng(4)
    place = np.zeros(3) if laser is None else laser
    odometry = [np.array((0.5, 0.2, 0.3))]
    for before, after in pairwise(true):
        motion = relative(before, after)
        odometry.append(compose(odometry[-1], motion * 1.1 + draw.normal(0, (0.01, 0.01, 0.03))))
    records = []
    step = np.pi / BEAMS
    for index, (pose, measured) in enumerate(zip(true, odometry, strict=True)):
        x, y, yaw = compose(pose, place)
        ranges = cast_rays(rooms(), (x, y), yaw - np.pi / 2 + step * np.arange(BEAMS), 10.0)
        ranges = ranges + draw.normal(0, 0.01, BEAMS)
        px, py, turn = measured.tolist()
        lx, ly, lyaw = place.tolist()
        records.append(
            LaserRecord(index, 10 + index, ranges, -np.pi / 2, step, 9.9, (px, py, turn), (lx, ly, lyaw))
        )
    return relative(true[0], true), records


def write_carmen(path: Path, records: list[LaserRecord]) -> None:
    """Write a CARMEN log with odometry in the scans only."""
    lines = ["# a drive through two rooms"]
    for each in records:
        ranges = " ".join(f"{value:.3f}" for value in each.ranges)
        pose = " ".join(f"{value:.6f}" for value in each.odometry)
        lines.append(f"FLASER {len(each.ranges)} {ranges} {pose} {pose} {each.time} host {each.time}")
    path.write_text("\n".join(lines) + "\n")


def write_bag(
    path: Path,
    records: list[LaserRecord],
    *,
    scan: str = "/scan",
    odometry: str = "/odom",
    upside_down: bool = False,
) -> None:
    """Write a ROS 1 bag: the laser stands in ``/tf_static``, odometry comes between the scans.

    Upside down, the laser sees the same and counts its beams the other way round.
    """
    store = typestore()
    kinds: Any = store.types
    transforms = kinds["tf2_msgs/msg/TFMessage"]
    with Writer(path) as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (
                ("/tf_static", "tf2_msgs/msg/TFMessage"),
                (scan, "sensor_msgs/msg/LaserScan"),
                (odometry, "nav_msgs/msg/Odometry"),
            )
        }

        def put(topic: str, time: float, message: Any) -> None:
            raw = store.serialize_ros1(message, topics[topic].msgtype)
            writer.write(topics[topic], int(time * 1e9), raw)

        def header(time: float, frame: str) -> Any:
            stamp = kinds["builtin_interfaces/msg/Time"](int(time), int(time % 1 * 1e9))
            return kinds["std_msgs/msg/Header"](0, stamp, frame)

        def turn(yaw: float) -> Any:
            return kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, sin(yaw / 2), cos(yaw / 2))

        def step(time: float, parent: str, child: str, x: float) -> Any:
            moved = kinds["geometry_msgs/msg/Vector3"](x, 0.0, 0.0)
            half = np.pi / 4 if upside_down else 0.0  # both steps roll by a quarter turn
            rolled = kinds["geometry_msgs/msg/Quaternion"](sin(half), 0.0, 0.0, cos(half))
            transform = kinds["geometry_msgs/msg/Transform"](moved, rolled)
            return kinds["geometry_msgs/msg/TransformStamped"](header(time, parent), child, transform)

        start = records[0].time
        steps = [step(start, "base_link", "plate", FRONT[0] / 2), step(start, "plate", "laser", FRONT[0] / 2)]
        put("/tf_static", start - 1, transforms(steps))
        for each in records:
            x, y, yaw = each.odometry
            pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](x, y, 0.0), turn(yaw))
            zero = kinds["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            twist = kinds["geometry_msgs/msg/TwistWithCovariance"](
                kinds["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
            )
            with_covariance = kinds["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
            put(
                odometry,
                each.time,
                kinds["nav_msgs/msg/Odometry"](
                    header(each.time, "odom"), "base_link", with_covariance, twist
                ),
            )
            ranges, first = np.asarray(each.ranges, np.float32), each.angle_min
            if upside_down:
                ranges, first = ranges[::-1].copy(), -float(each.angles()[-1])
            scanned = kinds["sensor_msgs/msg/LaserScan"](
                header(each.time, "laser"),
                first,
                -each.angle_min,
                each.angle_increment,
                0.0,
                0.0,
                0.05,
                each.range_max,
                ranges,
                np.zeros(0, np.float32),
            )
            put(scan, each.time, scanned)
