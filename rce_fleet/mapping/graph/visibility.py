"""Whether scans saw through what another scan reports: the check that a match in free space cannot pass."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, inverse, transform_points

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.scan_points import ScanPoints

MARGIN = 0.25
"""A beam sees through a point if it ends this much farther away, metres..."""
SHARE = 0.03
"""... plus this share of the distance."""

FEWEST = 3
"""Scans with fewer beams see through nothing."""


def seen_through(
    points: NDArray[np.float64], scan: ScanPoints, pose: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which points a scan saw through, shape (N,).

    The beam to a point and both its neighbours must end well behind it; beams without return do not count, as
    glass and black surfaces return nothing.

    Args:
        points: shape (N, 2), metres.
        scan: The scan.
        pose: Its pose in the points' frame, shape (3,).
    """
    beams = len(scan.ranges)
    if beams < FEWEST or len(points) == 0:
        return np.zeros(len(points), np.bool_)
    local = transform_points(inverse(compose(pose, np.array(scan.laser))), points)
    distance = np.hypot(local[:, 0], local[:, 1])
    turn = np.sign(scan.angle_increment)  # the beams of a laser that is upside down go clockwise
    angle = np.mod(turn * (np.arctan2(local[:, 1], local[:, 0]) - scan.angle_min), 2 * np.pi)
    beam = np.round(angle / abs(scan.angle_increment)).astype(np.int64)
    inside = (beam >= 1) & (beam < beams - 1)
    beam = np.where(inside, beam, 1)
    around = np.stack([scan.ranges[beam + step] for step in (-1, 0, 1)])
    ended = np.where(np.isfinite(around), around, 0.0).min(0)
    through: NDArray[np.bool_] = inside & (ended > distance * (1 + SHARE) + MARGIN)
    return through


def conflict_share(
    points: NDArray[np.float64], views: Iterable[tuple[ScanPoints, NDArray[np.float64]]]
) -> float:
    """Return the share of points that at least one of the scans saw through.

    Args:
        points: shape (N, 2), metres.
        views: Scans and their poses in the points' frame.
    """
    if len(points) == 0:
        return 0.0
    through = np.zeros(len(points), np.bool_)
    for scan, pose in views:
        through |= seen_through(points, scan, pose)
    return float(through.mean())
