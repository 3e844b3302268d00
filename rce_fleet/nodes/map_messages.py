"""Maps and scans as ROS messages, and back."""

from __future__ import annotations

from math import atan2, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.tf import Transform, Vector
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.scan import LaserScan
from rce_fleet.navigation.scans import is_count_of
from rce_fleet.nodes.planar import angles_from_above, pose_fields

if TYPE_CHECKING:
    from rce.ros.types import Message, Time
    from rce_fleet.maps.occupancy_map import OccupancyMap

MAX_BEAMS = 100_000


def metadata_fields(grid: OccupancyMap, loaded: Time) -> dict[str, Any]:
    """Return the fields of a ``nav_msgs/MapMetaData``.

    Args:
        grid: The map.
        loaded: When it was loaded.
    """
    return {
        "map_load_time": loaded,
        "resolution": grid.resolution,
        "width": grid.columns,
        "height": grid.rows,
        "origin": pose_fields(grid.origin),
    }


def map_fields(grid: OccupancyMap, frame: str, stamp: Time, loaded: Time | None = None) -> dict[str, Any]:
    """Return the fields of a ``nav_msgs/OccupancyGrid``.

    Args:
        grid: The map.
        frame: The frame that its origin is given in.
        stamp: When it holds.
        loaded: When it was loaded; by default at ``stamp``.
    """
    return {
        "header": {"stamp": stamp, "frame_id": frame},
        "info": metadata_fields(grid, stamp if loaded is None else loaded),
        "data": grid.data.reshape(-1),
    }


def read_scan(message: Message, base_from_laser: Transform) -> LaserScan:
    """Return a ``sensor_msgs/LaserScan`` as seen from the robot's base. The laser may be upside down.

    Args:
        message: The scan.
        base_from_laser: Where the laser is on the base.

    Raises:
        ValueError: Its angles, limits or length are not those of a scan; the text says what is expected.
    """
    numbers = (message.angle_min, message.angle_max, message.angle_increment, message.range_max)
    if not all(map(isfinite, numbers)) or message.angle_increment == 0:
        raise ValueError(
            f"angle_min {numbers[0]}, angle_max {numbers[1]}, angle_increment {numbers[2]} and range_max"
            f" {numbers[3]} must be finite, and angle_increment must not be 0"
        )
    if not message.range_max > max(message.range_min, 0):
        raise ValueError(
            f"range_max {message.range_max} m must be greater than range_min {message.range_min} m"
        )
    count = len(message.ranges)
    expected = (message.angle_max - message.angle_min) / message.angle_increment + 1
    if not 1 <= count <= MAX_BEAMS or not is_count_of(count, expected):
        raise ValueError(f"it has {count} ranges; its angles are those of {expected:.0f}")
    forward = base_from_laser.rotation.rotate(Vector(x=1.0))
    angle_min, angle_increment = angles_from_above(
        base_from_laser, message.angle_min, message.angle_increment
    )
    at = base_from_laser.translation
    return LaserScan(
        np.asarray(message.ranges, np.float64),
        angle_min,
        angle_increment,
        message.range_min,
        message.range_max,
        Pose(at.x, at.y, atan2(forward.y, forward.x)),
    )
