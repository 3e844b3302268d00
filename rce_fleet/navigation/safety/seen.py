"""What the safety stage remembers of scans: points in the odometry's frame, and which of them have moved."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose, compose, inverse, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_MOVED = 0.15
"""A point is new if an earlier scan saw this much farther in its direction, metres."""
_MOVED_SHARE = 0.03
"""What is added to it, as a share of the distance: the error of the heading between the scans."""
_EARLIER = 0.25
"""Age of the scan that the newest is compared with, seconds."""
_TIME_JUMP = 1.0
"""A scan that is older than the one before by more than this came after a jump of time, seconds."""
_KEEP_WITHIN = 2.0
"""Points farther away than this are not remembered, metres."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan with its place in the odometry's frame.

    Attributes:
        stamp: When, seconds.
        sensor: Pose of the sensor in the odometry's frame.
        ranges: Shape (N,), metres; ``inf`` where nothing was hit, NaN where nothing is known.
        angle_min: Direction of the first beam in the sensor's frame, radians.
        angle_increment: Angle between two beams, radians; not 0.
        nearest: Shortest range that the sensor can measure, metres.
    """

    stamp: float
    sensor: Pose
    ranges: Floats
    angle_min: float
    angle_increment: float
    nearest: float

    @property
    def hits(self) -> Floats:
        """The points that were hit, shape (M, 2), metres in the odometry's frame."""
        known = np.isfinite(self.ranges)
        angles = self.sensor.yaw + self.angle_min + self.angle_increment * np.flatnonzero(known)
        ranges = self.ranges[known]
        return np.stack(
            (self.sensor.x + ranges * np.cos(angles), self.sensor.y + ranges * np.sin(angles)), axis=1
        )

    def ranges_towards(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the shortest range of the beams around each point's direction, and the point's distance.

        The beam nearest to the direction and its two neighbours count, so that the loss of one echo is not
        taken for free space. Directions without a beam, and beams of which nothing is known, give 0.
        """
        dx, dy = points[:, 0] - self.sensor.x, points[:, 1] - self.sensor.y
        away = np.hypot(dx, dy)
        off = np.arctan2(dy, dx) - self.sensor.yaw - self.angle_min
        if self.angle_increment < 0:
            off = -off
        step = abs(self.angle_increment)
        beam = np.rint((off % (2 * pi)) / step).astype(np.intp)
        count = len(self.ranges)
        full = count * step > 2 * pi - 1.5 * step
        if full:
            beam %= count
        inside = beam < count
        around = [
            np.clip(beam + shift, 0, count - 1) if not full else (beam + shift) % count
            for shift in (-1, 0, 1)
        ]
        known = np.where(np.isnan(self.ranges), 0.0, self.ranges)
        seen = np.minimum.reduce([known[one] for one in around]) if count else np.zeros(len(points))
        return np.where(inside, seen, 0.0), away


class SeenPoints:
    """The obstacles around the robot.

    Points that the newest scan does not cover (outside its angles, or nearer than it can measure) are
    remembered for a while; those that it sees through are forgotten.

    Args:
        memory: How long points are remembered, seconds.
    """

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self._scans: list[Scan] = []
        self._old = np.empty((0, 3))
        self._points = np.empty((0, 2))
        self._moving = np.empty((0, 2))

    @property
    def newest(self) -> Scan | None:
        """The newest scan."""
        return self._scans[-1] if self._scans else None

    @property
    def points(self) -> Floats:
        """Points of obstacles, shape (M, 2), metres in the odometry's frame."""
        return self._points

    @property
    def moving(self) -> Floats:
        """Those of them that are where there was free space before, shape (K, 2)."""
        return self._moving

    def take(self, scan: Scan) -> None:
        """Take a scan; one that is older than the newest is ignored."""
        before = self.newest
        if before is not None and before.stamp - scan.stamp > _TIME_JUMP:
            self.forget()
            before = None
        if before is not None and scan.stamp < before.stamp:
            return
        self._remember(scan, before)
        hits = scan.hits
        self._moving = self._moved(scan, hits)
        self._points = np.concatenate((hits, self._old[:, :2]))
        self._scans.append(scan)
        # The last scan that is old enough to compare with stays, and all after it.
        old = [one for one in self._scans if scan.stamp - one.stamp >= _EARLIER]
        if old:
            del self._scans[: self._scans.index(old[-1])]

    def forget(self) -> None:
        """Forget everything: time or odometry jumped."""
        self._scans.clear()
        self._old, self._points, self._moving = np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2))

    def _remember(self, scan: Scan, before: Scan | None) -> None:
        if before is None or self._memory <= 0:
            return
        hits = before.hits
        stamped = np.column_stack((hits, np.full(len(hits), before.stamp)))
        kept = np.concatenate((self._old, stamped))
        seen, away = scan.ranges_towards(kept[:, :2])
        covered = (seen > 0) & (away >= scan.nearest)
        young = scan.stamp - kept[:, 2] <= self._memory
        self._old = kept[~covered & young & (away <= _KEEP_WITHIN)]
        self._old = _thinned(self._old)

    def _moved(self, scan: Scan, hits: Floats) -> Floats:
        earlier = next((one for one in self._scans if scan.stamp - one.stamp >= _EARLIER / 2), None)
        if earlier is None or not len(hits):
            return np.empty((0, 2))
        seen, away = earlier.ranges_towards(hits)
        return hits[seen > away + _MOVED + _MOVED_SHARE * away]


def _thinned(points: Floats) -> Floats:
    """Return one point, the youngest, for each square of 2 cm."""
    if not len(points):
        return points
    order = np.argsort(-points[:, 2], kind="stable")
    squares = np.floor(points[order, :2] / 0.02).astype(np.int64)
    _, first = np.unique(squares, axis=0, return_index=True)
    return points[order[first]]


def in_frame(base: Pose, points: Floats) -> Floats:
    """Return points of the parent frame of ``base`` in the frame of ``base``, shape (M, 2)."""
    return transform_points(inverse(base.as_array()), points)


def sensor_pose(odom_from_base: Pose, base_from_sensor: Pose) -> Floats:
    """Return the pose of a sensor in the odometry's frame, shape (3,)."""
    return compose(odom_from_base.as_array(), base_from_sensor.as_array())
