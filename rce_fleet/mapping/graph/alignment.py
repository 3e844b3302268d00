"""Sub-cell refinement of a scan's pose: points onto lines, by Gauss-Newton, with a prior.

After Censi 2008, "An ICP variant using a point-to-line metric".
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from rce_fleet.geometry.angles import wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.scan_points import ScanPoints

POINT_SIGMA = 0.03
"""Standard deviation of a point's distance from its line, metres."""
CORRELATION = 10.0
"""Neighbouring points err alike: so many count as one in the information."""
OUTLIER = 0.06
"""Scale of the robust (Cauchy) weight of a point's distance, metres."""
REACHES = (0.5, 0.3, 0.2, 0.15, 0.15, 0.15, 0.15, 0.15)
"""Greatest distance of a point from its partner in each iteration, metres."""
SAME_SIDE = 0.5
"""Least cosine between the normals of partners; keeps the two sides of a wall apart."""
INLIER = 0.1
FEWEST = 8
SETTLED = 2e-4
RIDGE = 1e-3 * np.eye(3)


class Reference:
    """Points on lines to align scans to.

    Args:
        points: shape (N, 2), metres, in one frame.
        normals: Unit normals of the lines, shape (N, 2).
    """

    def __init__(self, points: NDArray[np.float64], normals: NDArray[np.float64]) -> None:
        self.points = points
        self.normals = normals
        self.tree = cKDTree(points, balanced_tree=False, compact_nodes=False) if len(points) else None


@dataclass(frozen=True, slots=True)
class Alignment:
    """A refined pose.

    Attributes:
        pose: (x, y, yaw) of the scan in the reference's frame, shape (3,).
        information: Inverse covariance of the pose from the points alone, shape (3, 3).
        inliers: Share of the scan's points with a normal that lie within a decimetre of a line of the
            reference.
        spread: Root of the mean squared distance of the inliers from their lines, metres.
    """

    pose: NDArray[np.float64]
    information: NDArray[np.float64]
    inliers: float
    spread: float


def align(
    scan: ScanPoints,
    reference: Reference,
    start: NDArray[np.float64],
    *,
    prior: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    reaches: tuple[float, ...] = REACHES,
) -> Alignment:
    """Return the pose near ``start`` at which a scan's points lie on the reference's lines.

    Args:
        scan: The scan.
        reference: What it is aligned to.
        start: First estimate (x, y, yaw) in the reference's frame, shape (3,).
        prior: Expected pose, shape (3,), and its information, shape (3, 3).
        reaches: Greatest distance of partners in each iteration, metres; the last one repeats at most so
            often.
    """
    pose = np.array(start, np.float64)
    local, local_normals = scan.line_points, scan.line_normals
    nothing = Alignment(pose, np.zeros((3, 3)), 0.0, 0.0)
    if reference.tree is None or len(local) < FEWEST:
        return nothing
    hessian = np.zeros((3, 3))
    inliers, spread = 0.0, 0.0
    for reach in reaches:
        c, s = cos(pose[2]), sin(pose[2])
        turn = np.array(((c, s), (-s, c)))
        arms = local @ turn
        placed = arms + pose[:2]
        _, partner = reference.tree.query(placed, distance_upper_bound=reach)
        partner[partner == len(reference.points)] = (
            0  # without a partner: its distance is found too large below
        )
        normals = reference.normals[partner]
        apart = placed - reference.points[partner]
        used = ((local_normals @ turn) * normals).sum(1) > SAME_SIDE
        used &= (apart * apart).sum(1) < reach * reach
        if np.count_nonzero(used) < FEWEST:
            return nothing
        normals, arms = normals[used], arms[used]
        distance = (apart[used] * normals).sum(1)
        rows = np.empty((len(normals), 3))
        rows[:, :2] = normals
        rows[:, 2] = normals[:, 1] * arms[:, 0] - normals[:, 0] * arms[:, 1]
        weighted = (
            rows * (1.0 / ((1.0 + (distance / OUTLIER) ** 2) * (POINT_SIGMA**2 * CORRELATION)))[:, None]
        )
        hessian = weighted.T @ rows
        gradient = weighted.T @ distance
        total = hessian + RIDGE
        if prior is not None:
            error = pose - prior[0]
            error[2] = wrap(error[2])
            total = total + prior[1]
            gradient = gradient + prior[1] @ error
        step = np.linalg.solve(total, -gradient)
        pose = pose + step
        near = distance[np.abs(distance) < INLIER]
        inliers = len(near) / len(local)
        spread = sqrt(float(near @ near) / len(near)) if len(near) else 0.0
        if reach <= reaches[-1] and np.abs(step).max() < SETTLED:
            break
    pose[2] = wrap(pose[2])
    return Alignment(pose, hessian, inliers, spread)
