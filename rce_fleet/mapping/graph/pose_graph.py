"""Sparse optimization of a graph of poses by Levenberg-Marquardt, with robust edges (Cauchy).

After Grisetti et al. 2010, "A tutorial on graph-based SLAM".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from rce_fleet.geometry.angles import wrap_array
from rce_fleet.geometry.poses import relative

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_DAMPING = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Measured relative poses.

    Attributes:
        first: Numbers of the poses in whose frames the others were measured, shape (E,).
        second: Numbers of the measured poses, shape (E,).
        poses: Measured (x, y, yaw), shape (E, 3).
        information: Inverse covariances, shape (E, 3, 3).
        robust: Scale of the robust weight, in standard deviations; ``inf`` for none; shape (E,).
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    poses: NDArray[np.float64]
    information: NDArray[np.float64]
    robust: NDArray[np.float64]


def edge_errors(poses: NDArray[np.float64], edges: Edges) -> NDArray[np.float64]:
    """Return what the poses differ from the measured ones, in the frames of the first, shape (E, 3)."""
    errors = relative(poses[edges.first], poses[edges.second]) - edges.poses
    errors[:, 2] = wrap_array(errors[:, 2])
    return errors


def squared_distances(poses: NDArray[np.float64], edges: Edges) -> NDArray[np.float64]:
    """Return the squared Mahalanobis distances of the edges, shape (E,)."""
    errors = edge_errors(poses, edges)
    squared: NDArray[np.float64] = np.einsum("ei,eij,ej->e", errors, edges.information, errors)
    return squared


def _cost(squared: NDArray[np.float64], robust: NDArray[np.float64]) -> float:
    with np.errstate(invalid="ignore"):
        scaled = np.where(np.isinf(robust), squared, robust**2 * np.log1p(squared / robust**2))
    return float(scaled.sum())


def optimize(
    poses: NDArray[np.float64],
    edges: Edges,
    *,
    fixed: NDArray[np.bool_],
    iterations: int = 20,
    settled: float = 1e-4,
) -> NDArray[np.float64]:
    """Return the poses that fit the edges best.

    Args:
        poses: First estimates, shape (N, 3).
        edges: What was measured.
        fixed: Poses that stay, shape (N,); at least one in each connected part, else it may float.
        iterations: Greatest number of steps.
        settled: The last step moves no pose by more than this, metres and radians.
    """
    poses = np.array(poses, np.float64)
    free = np.flatnonzero(~fixed)
    if not len(free) or not len(edges.first):
        return poses
    place = np.full(len(poses), -1, np.int64)
    place[free] = np.arange(len(free))
    pattern = _pattern(place, edges)
    damping = 1e-6
    cost = _cost(squared_distances(poses, edges), edges.robust)
    for _ in range(iterations):
        hessian, gradient = _normal_equations(poses, edges, place, pattern)
        diagonal = hessian.diagonal()
        while True:
            damped = hessian.copy()
            damped.setdiag(diagonal * (1 + damping) + 1e-9)
            step = splu(
                damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            ).solve(-gradient)
            moved = poses.copy()
            moved[free] += step.reshape(-1, 3)
            moved[free, 2] = wrap_array(moved[free, 2])
            moved_cost = _cost(squared_distances(moved, edges), edges.robust)
            if moved_cost <= cost * (1 + 1e-12) or damping > MOST_DAMPING:
                break
            damping *= 10
        if moved_cost > cost * (1 + 1e-12):
            break
        poses, cost = moved, moved_cost
        damping = max(1e-9, damping / 10)
        if np.abs(step).max() < settled:
            break
    return poses


def _pattern(
    place: NDArray[np.int64], edges: Edges
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return rows and columns of the entries of the four blocks of each edge, and which are of free poses."""
    one, two = place[edges.first], place[edges.second]
    block_rows = np.concatenate((one, one, two, two))
    block_columns = np.concatenate((one, two, one, two))
    offsets = np.arange(3)
    rows = np.broadcast_to((3 * block_rows[:, None, None] + offsets[:, None]), (len(block_rows), 3, 3))
    columns = np.broadcast_to((3 * block_columns[:, None, None] + offsets), (len(block_rows), 3, 3))
    used = (block_rows >= 0) & (block_columns >= 0)
    return rows[used].ravel(), columns[used].ravel(), used


def _normal_equations(
    poses: NDArray[np.float64],
    edges: Edges,
    place: NDArray[np.int64],
    pattern: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]],
) -> tuple[csc_matrix, NDArray[np.float64]]:
    rows, columns, used = pattern
    first, second = poses[edges.first], poses[edges.second]
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    delta = second[:, :2] - first[:, :2]
    count = len(first)
    by_first = np.zeros((count, 3, 3))
    by_first[:, 0, 0], by_first[:, 0, 1] = -c, -s
    by_first[:, 1, 0], by_first[:, 1, 1] = s, -c
    by_first[:, 0, 2] = -s * delta[:, 0] + c * delta[:, 1]
    by_first[:, 1, 2] = -c * delta[:, 0] - s * delta[:, 1]
    by_first[:, 2, 2] = -1
    by_second = np.zeros((count, 3, 3))
    by_second[:, 0, 0], by_second[:, 0, 1] = c, s
    by_second[:, 1, 0], by_second[:, 1, 1] = -s, c
    by_second[:, 2, 2] = 1
    errors = edge_errors(poses, edges)
    squared = np.einsum("ei,eij,ej->e", errors, edges.information, errors)
    weights = 1.0 / (1.0 + squared / edges.robust**2)
    information = edges.information * weights[:, None, None]
    from_first = np.swapaxes(by_first, 1, 2) @ information
    from_second = np.swapaxes(by_second, 1, 2) @ information
    blocks = np.concatenate(
        (from_first @ by_first, from_first @ by_second, from_second @ by_first, from_second @ by_second)
    )
    size = 3 * int(place.max() + 1)
    hessian = csc_matrix((blocks[used].ravel(), (rows, columns)), shape=(size, size))
    gradient = np.zeros((len(poses), 3))
    np.add.at(gradient, edges.first, np.einsum("eij,ej->ei", from_first, errors))
    np.add.at(gradient, edges.second, np.einsum("eij,ej->ei", from_second, errors))
    return hessian, gradient[place >= 0].ravel()
