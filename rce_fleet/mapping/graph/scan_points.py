"""Points and normals of one scan, thinned evenly: what is matched."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord

NEIGHBOURS = 3
"""Beams on each side from which a normal is estimated."""
NEAR = 0.15
"""Neighbours count within this distance plus a few gaps between beams, metres."""
GAPS = 4.0
FEWEST = 3
FLATNESS = 0.15
"""A point has a normal if its neighbours spread at most this much less (as variance) across than along
their line."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """One scan, prepared for matching; all in the robot's base frame.

    Attributes:
        points: Ends of beams, shape (N, 2), metres; at most one in each cell of the thinning grid.
        normals: Unit normals that point to the laser, shape (N, 2); zero where the surface is unknown.
        line_points: Those of the points that have a normal, shape (M, 2).
        line_normals: Their normals, shape (M, 2).
        ranges: All ranges as measured, shape (B,), float32, metres; ``inf`` where nothing returned.
        angle_min: Direction of beam 0 in the laser's frame, radians.
        angle_increment: Angle between beams, radians.
        laser: Pose (x, y, yaw) of the laser on the base.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    laser: tuple[float, float, float] = (0.0, 0.0, 0.0)
    line_points: NDArray[np.float64] = field(init=False)
    line_normals: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        has_normal = self.normals.any(1)
        object.__setattr__(self, "line_points", np.ascontiguousarray(self.points[has_normal]))
        object.__setattr__(self, "line_normals", np.ascontiguousarray(self.normals[has_normal]))

    def __len__(self) -> int:
        return len(self.points)


def prepare_scan(record: LaserRecord, *, farthest: float, cell: float) -> ScanPoints:
    """Return a scan's points and normals.

    Args:
        record: The scan; ranges that are not finite, not positive or not below ``range_max`` are left out.
        farthest: Points farther than this from the laser are left out, metres.
        cell: Size of the cells of which each keeps one point, metres.
    """
    ranges = np.asarray(record.ranges, np.float64)
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(ranges) & (ranges > 0) & (ranges < record.range_max)
    used = seen & (np.where(seen, ranges, np.inf) <= farthest)
    x, y, yaw = record.laser
    angles = record.angle_min + record.angle_increment * np.arange(len(ranges)) + yaw
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    ends = np.where(used, ranges, 0.0)[:, None] * directions
    normals = _normals(ends, used, np.where(used, ranges, 0.0) * abs(record.angle_increment))
    kept = np.flatnonzero(used)
    kept = kept[_thin(ends[kept], cell)]
    return ScanPoints(
        points=ends[kept] + (x, y),
        normals=normals[kept],
        ranges=np.where(seen, ranges, np.inf).astype(np.float32),
        angle_min=record.angle_min,
        angle_increment=record.angle_increment,
        laser=record.laser,
    )


def _thin(points: NDArray[np.float64], cell: float) -> NDArray[np.intp]:
    """Return the indexes of the first point in each cell, ascending."""
    keys = np.floor(points / cell).astype(np.int64)
    _, first = np.unique(keys[:, 0] * (1 << 32) + keys[:, 1], return_index=True)
    return np.sort(first)


def _normals(
    ends: NDArray[np.float64], used: NDArray[np.bool_], gaps: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return normals by the main axes of each point's neighbours; zero where these are not on a line."""
    count = len(ends)
    if count == 0:
        return np.zeros((0, 2))
    offsets = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
    index = np.arange(count)[:, None] + offsets
    inside = (index >= 0) & (index < count)
    index = np.clip(index, 0, count - 1)
    apart = ends[index] - ends[:, None, :]
    near = inside & used[index] & used[:, None]
    near &= np.einsum("nkd,nkd->nk", apart, apart) <= (NEAR + GAPS * gaps[:, None]) ** 2
    number = np.maximum(near.sum(1), 1)
    weights = near[:, :, None]
    apart = np.where(weights, apart, 0.0)
    apart = np.where(weights, apart - apart.sum(1, keepdims=True) / number[:, None, None], 0.0)
    xx, yy = (apart**2).sum(1).T / number
    xy = (apart[:, :, 0] * apart[:, :, 1]).sum(1) / number
    half = 0.5 * np.hypot(xx - yy, 2 * xy)
    middle = 0.5 * (xx + yy)
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    normals = np.column_stack((-np.sin(along), np.cos(along)))
    normals *= np.where(np.einsum("nd,nd->n", normals, ends) > 0, -1.0, 1.0)[:, None]
    is_line = (near.sum(1) >= FEWEST) & (middle - half < FLATNESS * (middle + half))
    normals[~is_line] = 0.0
    return normals
