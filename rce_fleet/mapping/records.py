"""Laser scans with the odometry at their time: what mappers take, wherever it was recorded."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

TOP_BAND = 0.995
"""From this share of a log's greatest reading on, readings mean "no return"."""
PILE_COUNT = 20
PILE_EXCESS = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class LaserRecord:
    """One scan of a log.

    Attributes:
        index: Number of the scan in the log, from 0.
        time: When it was taken, seconds; times of a log may go backwards.
        ranges: shape (N,), float64, metres; ``inf`` where nothing returned. N may be 0.
        angle_min: Direction of beam 0 in the laser's frame, radians.
        angle_increment: Angle from one beam to the next, radians; negative for a laser that is upside down.
        range_max: Greatest range the laser measures, metres.
        odometry: Dead reckoning ``(x, y, yaw)`` of the robot's base at that time.
        laser: Pose ``(x, y, yaw)`` of the laser on the base.
    """

    index: int
    time: float
    ranges: NDArray[np.float64]
    angle_min: float
    angle_increment: float
    range_max: float
    odometry: tuple[float, float, float]
    laser: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def angles(self) -> NDArray[np.float64]:
        """Return the directions of the beams in the laser's frame, shape (N,), radians."""
        return self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=np.float64)

    def points(self, *, farthest: float = inf) -> NDArray[np.float64]:
        """Return where beams ended within ``farthest`` metres, in the base's frame, shape (M, 2)."""
        seen = np.isfinite(self.ranges) & (self.ranges > 0) & (self.ranges <= min(farthest, self.range_max))
        x, y, yaw = self.laser
        directions = self.angles()[seen] + yaw
        ranges = self.ranges[seen]
        return np.column_stack((x + ranges * np.cos(directions), y + ranges * np.sin(directions)))


@dataclass(frozen=True, slots=True)
class ScanLog:
    """A log of laser scans.

    Attributes:
        name: File that it was read from.
        records: Its scans, in the file's order.
        faults: What could not be used, each as ``FILE:LINE: reason``.
    """

    name: str
    records: list[LaserRecord]
    faults: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Time from the first scan to the last one (the greatest one, where times go backwards), seconds."""
        times = [record.time for record in self.records]
        return max(times) - times[0] if times else 0.0


def no_return_range(scans: Sequence[NDArray[np.float64]]) -> float:
    """Return the range from which on readings of a log mean that nothing returned, metres.

    Lasers report a missing return as their greatest range or just above (81.83 and 81.91 m are two codes of
    one common laser). Two rules find it, without knowledge of the laser:

    - A reading within half a percent of the greatest one is not a measurement. Where it was one after all,
      this loses the last centimetres of the farthest walls.
    - Below that, a value that more than one reading per scan shares exactly, with few readings beyond it,
      is a limit at which some program cut the ranges.

    Args:
        scans: Readings as recorded, each of shape (N,), metres; values that are not finite or not positive
            count as no readings.
    """
    if not scans:
        return inf
    readings = np.concatenate(scans)
    readings = readings[np.isfinite(readings) & (readings > 0)]
    if not len(readings):
        return inf
    limit = float(readings.max()) * TOP_BAND
    values, counts = np.unique(readings[readings < limit], return_counts=True)
    for value, count in zip(values[::-1], counts[::-1], strict=True):
        beyond = int(counts[values > value].sum())
        if count >= max(PILE_COUNT, len(scans)) and count > PILE_EXCESS * (beyond + 1):
            return float(value)
        if beyond > count:
            break
    return limit
