"""A planar range sensor: exact ranges, computed in numpy without a loop over beams or robots.

*Angular binning*: each edge and circle is projected on the interval of beams that it covers, and only those
pairs of beam and shape are intersected, instead of every beam with every shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, inf, isfinite, pi
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indexes = NDArray[np.intp]

MAX_BEAMS = 100_000
_TURN = 2 * pi
_TOGETHER = 12
"""Sensors that are computed together: more of them save no more calls, but leave the processor's cache."""


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """Properties of a lidar, or of a depth camera whose middle rows make a scan.

    Attributes:
        beams: Number of beams.
        field_of_view: Angle that the beams cover, radians. Over the full circle beam 0 points backwards
            (-pi); else the first and the last beam are at the ends of the field. Angles of
            ``sensor_msgs/LaserScan`` run upwards.
        min_range: A nearer obstacle gives no range but NaN, metres.
        max_range: Farthest range, metres.
        noise: Standard deviation of a range, metres.
        noise_squared: Part of the standard deviation that grows with the squared range, 1 / metres.
        quantum: Ranges are multiples of this, metres; 0 for none.
        drop_outs: Probability that a beam returns nothing.
        glass_returns: Probability that a beam is returned by glass; else it passes through.
        rate: Scans in a second.
        frame: The sensor's frame.
        x: Place in the robot's frame, metres forward.
        y: Place in the robot's frame, metres to the left.
        z: Height, metres; for the frame only.
        yaw: Direction in the robot's frame, radians.
    """

    beams: int = 360
    field_of_view: float = _TURN
    min_range: float = 0.05
    max_range: float = 6.0
    noise: float = 0.01
    noise_squared: float = 0.0
    quantum: float = 0.0
    drop_outs: float = 0.0
    glass_returns: float = 1.0
    rate: float = 10.0
    frame: str = "base_scan"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        if not 1 < self.beams <= MAX_BEAMS:
            raise ValueError(f"beams must be within 2 .. {MAX_BEAMS}, not {self.beams}")
        if not 0 < self.field_of_view <= _TURN + 1e-9:
            raise ValueError(f"field_of_view must be within 0 .. 2 pi radians, not {self.field_of_view}")
        if not 0 <= self.min_range < self.max_range or not isfinite(self.max_range):
            raise ValueError(
                f"ranges must be 0 <= min_range < max_range, not {self.min_range}, {self.max_range}"
            )
        if not all(0 <= error < inf for error in (self.noise, self.noise_squared, self.quantum)):
            raise ValueError("noise, noise_squared and quantum must be finite and not negative")
        if not self.rate > 0:
            raise ValueError(f"rate must be positive, not {self.rate}")
        if not all(map(isfinite, (self.x, self.y, self.z, self.yaw))):
            raise ValueError("x, y, z and yaw must be finite numbers")
        if not (0 <= self.drop_outs <= 1 and 0 <= self.glass_returns <= 1):
            raise ValueError("drop_outs and glass_returns are probabilities within 0 .. 1")

    @property
    def full_circle(self) -> bool:
        """Whether the beams cover the full circle."""
        return self.field_of_view >= _TURN - 1e-9

    @property
    def increment(self) -> float:
        """Angle between two beams, radians."""
        return _TURN / self.beams if self.full_circle else self.field_of_view / (self.beams - 1)

    @property
    def angle_min(self) -> float:
        """Angle of beam 0 in the sensor's frame, radians."""
        return -pi if self.full_circle else -self.field_of_view / 2

    @property
    def offset(self) -> float:
        """Distance of the sensor from the robot's middle, metres."""
        return hypot(self.x, self.y)

    def angles(self) -> Floats:
        """Direction of each beam in the sensor's frame, shape (beams,), radians."""
        return np.arange(self.beams, dtype=np.float64) * self.increment + self.angle_min

    def poses(self, robots: Floats) -> Floats:
        """Return the sensor's poses for poses of robots, both of shape (N, 3)."""
        x, y, yaw = robots.T
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.stack(
            (x + cos * self.x - sin * self.y, y + sin * self.x + cos * self.y, yaw + self.yaw), axis=1
        )


def cast(
    spec: LidarSpec, origin: tuple[float, float], yaw: float, segments: Floats, circles: Floats
) -> Floats:
    """Return the exact ranges of one scan, shape (beams,); as :func:`cast_many`."""
    ranges: Floats = cast_many(spec, np.array([(*origin, yaw)], np.float64), segments, circles)[0]
    return ranges


def cast_many(spec: LidarSpec, poses: Floats, segments: Floats, circles: Floats) -> Floats:
    """Return the exact ranges of a scan of each sensor.

    Args:
        spec: The sensors; their noise is not applied.
        poses: Places and directions of the sensors, shape (N, 3), metres, radians.
        segments: Edges, shape (M, 4): x, y of both ends, metres.
        circles: Shape (C, 3): x, y and radius, metres. A sensor does not see a circle that it is inside of.

    Returns:
        Shape (N, beams), metres, at most ``spec.max_range``.
    """
    ranges = np.full((len(poses), spec.beams), spec.max_range)
    for first in range(0, len(poses), _TOGETHER):
        part, seers = ranges[first : first + _TOGETHER].reshape(-1), poses[first : first + _TOGETHER]
        _cast_segments(spec, part, seers, segments)
        _cast_circles(spec, part, seers, circles)
    return ranges


def _cast_segments(spec: LidarSpec, ranges: Floats, poses: Floats, segments: Floats) -> None:
    ax, ay, bx, by = segments.T
    x, y, reach = poses[:, :1], poses[:, 1:2], spec.max_range
    near = np.minimum(ax, bx) < x + reach
    near &= np.maximum(ax, bx) > x - reach
    near &= np.minimum(ay, by) < y + reach
    near &= np.maximum(ay, by) > y - reach
    seers, edges = np.nonzero(near)
    x, y, yaw = poses[seers].T
    ax, ay, bx, by = ax[edges] - x, ay[edges] - y, bx[edges] - x, by[edges] - y
    first = np.arctan2(ay, ax) - yaw
    sweep = np.arctan2(by, bx) - yaw - first
    sweep = (sweep + pi) % _TURN - pi  # A straight edge is seen under less than pi.
    pairs, beams = _cover(spec, first + np.minimum(sweep, 0.0), np.abs(sweep))
    angles = spec.angle_min + beams * spec.increment + yaw[pairs]
    dx, dy = np.cos(angles), np.sin(angles)
    ex, ey = bx - ax, by - ay
    # Where beam t * d meets the edge a + s * e: t = (a x e) / (d x e).
    across = dx * ey[pairs] - dy * ex[pairs]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (ax * ey - ay * ex)[pairs] / across
    level = across == 0.0
    if level.any():  # An edge in line with a beam is hit at its nearer end.
        distance = np.where(level, np.minimum(np.hypot(ax, ay), np.hypot(bx, by))[pairs], distance)
    hit = distance >= 0.0
    np.minimum.at(ranges, (seers[pairs] * spec.beams + beams)[hit], distance[hit])


def _cast_circles(spec: LidarSpec, ranges: Floats, poses: Floats, circles: Floats) -> None:
    dx, dy = circles[:, 0] - poses[:, :1], circles[:, 1] - poses[:, 1:2]
    away = np.hypot(dx, dy)
    seers, seen = np.nonzero((away - circles[:, 2] < spec.max_range) & (away > circles[:, 2]))
    away, radius = away[seers, seen], circles[seen, 2]
    half = np.arcsin(radius / away)
    bearing = np.arctan2(dy[seers, seen], dx[seers, seen]) - poses[seers, 2]
    pairs, beams = _cover(spec, bearing - half, 2 * half)
    off = spec.angle_min + beams * spec.increment - bearing[pairs]
    along = away[pairs] * np.cos(off)
    across = away[pairs] * np.sin(off)
    inside = np.maximum(radius[pairs] ** 2 - across**2, 0.0)
    np.minimum.at(ranges, seers[pairs] * spec.beams + beams, along - np.sqrt(inside))


def _cover(spec: LidarSpec, start: Floats, width: Floats) -> tuple[Indexes, Indexes]:
    """Beams within intervals of angles, as pairs (interval, beam)."""
    begin = (start - spec.angle_min) % _TURN
    over = np.nonzero(begin + width >= _TURN - 1e-9)[0]  # These go on at the first beam.
    numbers = np.concatenate((np.arange(len(begin)), over))
    begin = np.concatenate((begin, begin[over] - _TURN))
    low = np.maximum(np.ceil(begin / spec.increment - 1e-9), 0).astype(np.intp)
    high = np.floor((begin + width[numbers]) / spec.increment + 1e-9).astype(np.intp)
    counts = np.maximum(np.minimum(high, spec.beams - 1) - low + 1, 0)
    pairs = np.repeat(numbers, counts)
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return pairs, np.repeat(low, counts) + steps


def measure(
    spec: LidarSpec, exact: Floats, rng: np.random.Generator, behind_glass: Floats | None = None
) -> Floats:
    """Return what a sensor reports of exact ranges.

    Args:
        spec: The sensor.
        exact: Ranges to the nearest thing, glass too, shape (beams,), metres.
        rng: Draws noise, drop-outs and returns of glass.
        behind_glass: Ranges to the nearest thing that is not glass; None without glass.

    Returns:
        Shape (beams,), metres: infinite where nothing returned, NaN nearer than ``spec.min_range``.
    """
    ranges = exact
    if behind_glass is not None and spec.glass_returns < 1:
        ranges = np.where(rng.random(spec.beams) < spec.glass_returns, exact, behind_glass)
    hit = ranges < spec.max_range
    if spec.drop_outs:
        hit &= rng.random(spec.beams) >= spec.drop_outs
    deviation = spec.noise + spec.noise_squared * ranges * ranges
    noisy = ranges + deviation * rng.standard_normal(spec.beams)
    if spec.quantum:
        noisy = np.round(noisy / spec.quantum) * spec.quantum
    noisy = np.where(noisy < spec.min_range, np.nan, np.minimum(noisy, spec.max_range))
    return np.where(hit, noisy, np.inf)
