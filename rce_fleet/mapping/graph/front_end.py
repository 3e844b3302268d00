"""Front end: the pose of each scan against the newest keyscans, with odometry as prior."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import compose, relative, transform_points
from rce_fleet.mapping.graph.alignment import Reference, align
from rce_fleet.mapping.graph.correlative import Window, find_match
from rce_fleet.mapping.graph.fields import FieldPyramid, make_field

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.parameters import GraphParameters
    from rce_fleet.mapping.graph.scan_points import ScanPoints

LEVELS = 5
WIDE = 3.0
"""How much larger the window is after a scan that did not match."""
TURN_STEP = 0.012
PRIOR_WEIGHT = 0.1
SIGMAS = 3.0
LARGE_REACH = 1.5
"""From this reach on a window is large, metres: matches in it need..."""
LARGE_SCORE = 0.5
LARGE_INLIERS = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """Some scans together, as a likelihood field and as lines, in one frame."""

    field: FieldPyramid
    reference: Reference


def make_submap(
    scans: Sequence[ScanPoints],
    poses: NDArray[np.float64],
    parameters: GraphParameters,
    *,
    levels: int = LEVELS,
) -> Submap:
    """Return the submap of scans at poses, shape (N, 3)."""
    points = np.concatenate(
        [transform_points(pose, scan.points) for pose, scan in zip(poses, scans, strict=True)]
    )
    on_lines = np.concatenate(
        [transform_points(pose, scan.line_points) for pose, scan in zip(poses, scans, strict=True)]
    )
    normals = np.concatenate(
        [
            transform_points((0.0, 0.0, pose[2]), scan.line_normals)
            for pose, scan in zip(poses, scans, strict=True)
        ]
    )
    field = make_field(points, cell=parameters.field_cell, spread=parameters.field_spread, levels=levels)
    return Submap(field, Reference(on_lines, normals))


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a scan was placed.

    Attributes:
        pose: (x, y, yaw) in the submap's frame, shape (3,).
        information: Inverse covariance of the pose there, odometry included, shape (3, 3).
        score: Score of the correlative match, 0 to 1; 0 without one.
        inliers: Share of points on the submap's lines.
    """

    pose: NDArray[np.float64]
    information: NDArray[np.float64]
    score: float
    inliers: float

    @property
    def is_matched(self) -> bool:
        """Whether the pose is from a match, not from odometry alone."""
        return self.score > 0


def odometry_information(moved: NDArray[np.float64], parameters: GraphParameters) -> NDArray[np.float64]:
    """Return the inverse covariance of a relative pose (x, y, yaw) by odometry, in the frame where it ends.

    The standard deviations grow with way and turn; they are the same along and across.
    """
    shift, turn = odometry_sigmas(moved, parameters)
    return np.diag((shift**-2, shift**-2, turn**-2))


def odometry_sigmas(moved: NDArray[np.float64], parameters: GraphParameters) -> tuple[float, float]:
    """Return the standard deviations of a relative pose by odometry: metres, radians."""
    way, turn = hypot(moved[0], moved[1]), abs(wrap(moved[2]))
    return (
        parameters.odometry_shift + parameters.odometry_shift_share * way,
        parameters.odometry_turn
        + parameters.odometry_turn_share * turn
        + parameters.odometry_turn_by_way * way,
    )


def place_scan(
    scan: ScanPoints,
    submap: Submap,
    before: NDArray[np.float64],
    moved: NDArray[np.float64],
    parameters: GraphParameters,
    sigma_scale: float = 1.0,
) -> Placement:
    """Return where a scan is on a submap.

    A match in a large window has to be better than one in a small window, as it is more often false.

    Args:
        scan: The scan.
        submap: What it is matched against.
        before: Pose of the scan before, in the submap's frame.
        moved: What odometry says that the robot moved since then, (x, y, yaw) in its own frame.
        parameters: Parameters.
        sigma_scale: Factor of the standard deviations of the odometry, to trust it less than usual.
    """
    expected = compose(before, moved)
    shift, turn = (sigma_scale * sigma for sigma in odometry_sigmas(moved, parameters))
    prior = odometry_information(moved, parameters) / sigma_scale**2
    if len(scan) < parameters.fewest_points:
        return Placement(expected, prior, 0.0, 0.0)
    placement = None
    for wider in (1.0, WIDE):
        window = Window(wider * SIGMAS * shift, min(wider * SIGMAS * turn, np.pi), TURN_STEP, PRIOR_WEIGHT)
        is_large = window.reach > LARGE_REACH
        least = max(parameters.least_score, LARGE_SCORE if is_large else 0.0)
        match = find_match(submap.field, scan.points, expected, window, at_least=least)
        if match is not None:
            aligned = align(scan, submap.reference, match.pose, prior=(expected, prior))
            if aligned.inliers > (LARGE_INLIERS if is_large else 0.0):
                placement = Placement(aligned.pose, aligned.information + prior, match.score, aligned.inliers)
                break
    return placement or Placement(expected, prior, 0.0, 0.0)


def in_frame_of(
    base: NDArray[np.float64], placement: Placement
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pose and information of a placement as seen from ``base``, a pose in the same frame."""
    c, s = np.cos(base[2]), np.sin(base[2])
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return relative(base, placement.pose), turn.T @ placement.information @ turn
