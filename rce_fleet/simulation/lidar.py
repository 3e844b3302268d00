"""A planar lidar: exact ranges, computed in numpy without a loop over beams.

*Angular binning*: each edge and circle is projected on the interval of beams that it covers, and only those
pairs of beam and shape are intersected, instead of every beam with every shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """Properties of a lidar.

    Attributes:
        beams: Number of beams, evenly over the full circle. Beam 0 points backwards (-pi), as angles of
            ``sensor_msgs/LaserScan`` run upwards.
        max_range: Farthest range, metres; beams that hit nothing nearer return it.
        noise: Standard deviation of a range, metres.
    """

    beams: int = 360
    max_range: float = 6.0
    noise: float = 0.01

    @property
    def increment(self) -> float:
        """Angle between two beams, radians."""
        return 2 * pi / self.beams

    def angles(self) -> Floats:
        """Direction of each beam seen from the robot, shape (beams,), radians."""
        return np.arange(self.beams, dtype=np.float64) * self.increment - pi


def cast(
    spec: LidarSpec, origin: tuple[float, float], yaw: float, segments: Floats, circles: Floats
) -> Floats:
    """Return the exact ranges of a scan.

    Args:
        spec: The lidar; its noise is not applied.
        origin: Place of the lidar, metres.
        yaw: Direction of the lidar, radians.
        segments: Edges, shape (N, 4): x, y of both ends, metres.
        circles: Shape (N, 3): x, y and radius, metres.

    Returns:
        Shape (beams,), metres, at most ``spec.max_range``.
    """
    ranges = np.full(spec.beams, spec.max_range)
    _cast_segments(spec, ranges, segments - (*origin, *origin), yaw)
    _cast_circles(spec, ranges, circles - (*origin, 0.0), yaw)
    return ranges


def _cast_segments(spec: LidarSpec, ranges: Floats, segments: Floats, yaw: float) -> None:
    ax, ay, bx, by = segments.T
    near = (
        (np.minimum(ax, bx) < spec.max_range)
        & (np.maximum(ax, bx) > -spec.max_range)
        & (np.minimum(ay, by) < spec.max_range)
        & (np.maximum(ay, by) > -spec.max_range)
    )
    ax, ay, bx, by = segments[near].T
    first = np.arctan2(ay, ax) - yaw
    sweep = np.arctan2(by, bx) - yaw - first
    sweep = (sweep + pi) % (2 * pi) - pi  # A straight edge is seen under less than pi.
    pairs, beams = _cover(spec, first + np.minimum(sweep, 0.0), np.abs(sweep))
    angles = -pi + beams * spec.increment + yaw
    dx, dy = np.cos(angles), np.sin(angles)
    ax, ay, bx, by = ax[pairs], ay[pairs], bx[pairs], by[pairs]
    ex, ey = bx - ax, by - ay
    across = dx * ey - dy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (ax * ey - ay * ex) / across
    # An edge in line with a beam is hit at its nearer end.
    distance = np.where(across == 0.0, np.minimum(np.hypot(ax, ay), np.hypot(bx, by)), distance)
    np.minimum.at(ranges, beams, np.where(distance >= 0.0, distance, spec.max_range))


def _cast_circles(spec: LidarSpec, ranges: Floats, circles: Floats, yaw: float) -> None:
    x, y, radius = circles.T
    away = np.hypot(x, y)
    near = (away - radius < spec.max_range) & (away > radius)
    x, y, radius, away = x[near], y[near], radius[near], away[near]
    half = np.arcsin(radius / away)
    bearing = np.arctan2(y, x) - yaw
    pairs, beams = _cover(spec, bearing - half, 2 * half)
    off = -pi + beams * spec.increment - bearing[pairs]
    along = away[pairs] * np.cos(off)
    across = away[pairs] * np.sin(off)
    inside = np.maximum(radius[pairs] ** 2 - across**2, 0.0)
    np.minimum.at(ranges, beams, along - np.sqrt(inside))


def _cover(spec: LidarSpec, start: Floats, width: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Beams within intervals of angles, as pairs (interval, beam)."""
    low = np.ceil((start + pi) / spec.increment - 1e-9).astype(np.intp)
    high = np.floor((start + width + pi) / spec.increment + 1e-9).astype(np.intp)
    counts = np.maximum(high - low + 1, 0)
    pairs = np.repeat(np.arange(len(counts)), counts)
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return pairs, (low[pairs] + steps) % spec.beams
