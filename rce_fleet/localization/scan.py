"""Laser scans, and the few of their beams that the filter uses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.localization.parameters import AmclParameters

ON_BASE = Pose(0.0, 0.0, 0.0)
APART = 0.1
"""Ends of beams that are nearer to each other than this see the same thing, metres: two cells of a usual map.
An error of the map there, or a thing that is not on it, is common to them."""


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """A scan, with the place of its laser on the robot.

    Attributes:
        ranges: shape (N,), metres; not finite, or ``range_max`` and more: no return.
        angle_min: Direction of beam 0 in the laser's frame, radians.
        angle_increment: Angle from one beam to the next, radians; negative for a laser that is upside down.
        range_min: Nearer ranges are not measurements, metres.
        range_max: Greatest range that is measured, metres.
        laser: Pose of the laser on the robot's base.
    """

    ranges: NDArray[np.float64]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    laser: Pose = ON_BASE


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams of a scan that the filter uses.

    Attributes:
        ranges: shape (K,), metres, all within 0 .. ``range_max``, which means no return.
        angles: shape (K,): directions in the frame of the robot's base, radians.
        range_max: Greatest range, metres.
        laser: Pose of the laser on the robot's base.
    """

    ranges: NDArray[np.float64]
    angles: NDArray[np.float64]
    range_max: float
    laser: Pose

    @property
    def returned(self) -> NDArray[np.bool_]:
        """Which beams hit something, shape (K,)."""
        return self.ranges < self.range_max

    @cached_property
    def ends(self) -> NDArray[np.float64]:
        """Where the beams that hit something end, in the frame of the base: shape (2, M), metres."""
        hit = self.returned
        ranges, angles = self.ranges[hit], self.angles[hit]
        return np.stack((self.laser.x + ranges * np.cos(angles), self.laser.y + ranges * np.sin(angles)))

    @cached_property
    def independence(self) -> float:
        """What the beams that hit something count for together, as a share of so many independent ones.

        A beam counts by the distance of its end from that of the beam before, up to ``APART``. So the same
        view tells the filter as much with 60 beams as with 600.
        """
        steps = np.diff(self.ends)
        if not steps.size:
            return 1.0
        return float(np.minimum(np.hypot(steps[0], steps[1]) / APART, 1.0).mean())


def select_beams(scan: LaserScan, parameters: AmclParameters) -> Beams:
    """Choose at most ``laser_max_beams`` beams of a scan, evenly spaced.

    Ranges below the least one count as no return, as in ROS's ``amcl``; a NaN is left out.
    """
    nearest, farthest = scan.range_min, scan.range_max
    if parameters.laser_min_range > 0:
        nearest = max(nearest, parameters.laser_min_range)
    if parameters.laser_max_range > 0:
        farthest = min(farthest, parameters.laser_max_range)
    step = max((len(scan.ranges) - 1) // (parameters.laser_max_beams - 1), 1)
    chosen = np.arange(0, len(scan.ranges), step)
    ranges = np.asarray(scan.ranges, np.float64)[chosen]
    measured = ~np.isnan(ranges)
    chosen = chosen[measured]
    ranges = ranges[measured]
    ranges[(ranges <= nearest) | (ranges > farthest)] = farthest
    angles = np.asarray(scan.laser.yaw + scan.angle_min + chosen * scan.angle_increment, np.float64)
    return Beams(ranges, angles, farthest, scan.laser)
