"""One message of a sensor in the plane of a costmap: where it saw obstacles, and how far free space."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.geometry.poses import Pose
    from rce_fleet.navigation.costmap.parameters import ObservationSource

    Floats = NDArray[np.float64]

_JUST_BELOW = 1e-4
"""How much shorter than its longest range a beam without return counts, metres; as costmap_2d's filter."""


@dataclass(frozen=True)
class Observation:
    """What a sensor saw, in the costmap's frame.

    Attributes:
        stamp: When, seconds.
        x: Place of the sensor, metres.
        y: The same along y.
        hits: Points of obstacles, shape (N, 2), metres.
        bearings: Directions of the rays, ascending, shape (K,), radians within -pi .. pi.
        reach: How far each ray passed free space, shape (K,), metres.
    """

    stamp: float
    x: float
    y: float
    hits: Floats
    bearings: Floats
    reach: Floats


def observe_scan(
    ranges: Floats,
    angle_min: float,
    angle_increment: float,
    range_limits: tuple[float, float],
    sensor: Pose,
    source: ObservationSource,
    stamp: float,
) -> Observation:
    """Return the observation of a ``sensor_msgs/LaserScan``.

    Beams with NaN, or with a range outside the limits, are left out. A beam of infinite range clears if the
    source's ``inf_is_valid`` is set.

    Args:
        ranges: Shape (N,), metres.
        angle_min: Direction of the first beam in the sensor's frame, radians.
        angle_increment: Angle between two beams, radians; negative for a sensor that is mounted upside down.
        range_limits: ``range_min`` and ``range_max``, metres.
        sensor: Pose of the sensor in the costmap's frame.
        source: Parameters of the sensor.
        stamp: Time of the scan, seconds.
    """
    shortest, longest = range_limits
    directions = sensor.yaw + angle_min + angle_increment * np.arange(len(ranges), dtype=np.float64)
    with np.errstate(invalid="ignore"):
        hit = (ranges >= shortest) & (ranges < longest)
        endless = np.isposinf(ranges) if source.inf_is_valid else np.zeros(len(ranges), np.bool_)
    used = hit | endless
    reach = np.where(endless, longest - _JUST_BELOW, np.where(hit, ranges, 0.0))
    cosine, sine = np.cos(directions), np.sin(directions)
    marked = hit & (reach <= source.obstacle_range) & (reach >= source.obstacle_min_range)
    marked &= source.marking
    hits = np.stack(
        (sensor.x + reach[marked] * cosine[marked], sensor.y + reach[marked] * sine[marked]), axis=1
    )
    used &= source.clearing
    return _sorted(stamp, sensor, hits, directions[used], np.minimum(reach[used], source.raytrace_range))


def observe_points(points: Floats, sensor: Pose, source: ObservationSource, stamp: float) -> Observation:
    """Return the observation of a point cloud.

    Points outside ``min_obstacle_height`` .. ``max_obstacle_height`` are left out.

    Args:
        points: Shape (N, 3), x, y, z in the costmap's frame, metres.
        sensor: Pose of the sensor in the costmap's frame.
        source: Parameters of the sensor.
        stamp: Time of the cloud, seconds.
    """
    finite = np.isfinite(points).all(axis=1)
    height = points[:, 2]
    with np.errstate(invalid="ignore"):
        used = finite & (height >= source.min_obstacle_height) & (height <= source.max_obstacle_height)
    x, y = points[used, 0] - sensor.x, points[used, 1] - sensor.y
    away = np.hypot(x, y)
    near = (away <= source.obstacle_range) & (away >= source.obstacle_min_range) & source.marking
    clearing = np.full(len(away), source.clearing)
    return _sorted(
        stamp,
        sensor,
        points[used, :2][near],
        np.asarray(np.arctan2(y, x), np.float64)[clearing],
        np.asarray(np.minimum(away, source.raytrace_range))[clearing],
    )


def _sorted(stamp: float, sensor: Pose, hits: Floats, directions: Floats, reach: Floats) -> Observation:
    bearings = (directions + pi) % (2 * pi) - pi
    order = np.argsort(bearings, kind="stable")
    return Observation(stamp, sensor.x, sensor.y, hits, bearings[order], reach[order])
