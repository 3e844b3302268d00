"""Matches scans with maps of tiles, in numpy; gives the same as :mod:`rce_fleet.mapping.match_kernels`."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper
from rce_fleet.geometry.angles import wrap
from rce_fleet.mapping.tiles import MASK, REACH, SHIFT, SPAN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]

ALONG = 0.1
"""Weight of the squared distance along a wall, relative to that across."""
NULL_LIKELIHOOD = -0.5
"""Smallest log-likelihood of a beam (GMapping's)."""
MAX_STEP_M = 0.25
MAX_STEP_RAD = 0.2
CONVERGED = 1e-4
"""Matching ends when a step is shorter than this, metres plus radians."""


@helper
def solve(matrix: Reals, right: Reals) -> Reals:
    """Return the solution of three equations, by Cramer's rule."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * bb + c * cc
    step = np.zeros(3)
    if determinant > 0:
        step[0] = (aa * right[0] + bb * right[1] + cc * right[2]) / determinant
        step[1] = (bb * right[0] + dd * right[1] + ee * right[2]) / determinant
        step[2] = (cc * right[0] + ee * right[1] + ff * right[2]) / determinant
    return step


@helper
def advance(pose: Reals, step: Reals) -> bool:
    """Move a pose by a step, shortened if it is long; return whether the step was negligible."""
    length = (step[0] ** 2 + step[1] ** 2) ** 0.5
    share = 1.0
    if length > MAX_STEP_M:
        share = MAX_STEP_M / length
    if abs(step[2]) * share > MAX_STEP_RAD:
        share = MAX_STEP_RAD / abs(step[2])
    pose[0] += share * step[0]
    pose[1] += share * step[1]
    pose[2] += share * step[2]
    return bool(length + abs(step[2]) < CONVERGED)


def _nearest_numpy(
    table: NDArray[np.int32], points: NDArray[np.float32], owner: NDArray[np.uint8], x: Reals, y: Reals
) -> tuple[NDArray[np.bool_], Reals, Reals, Reals, Reals]:
    """Return which places, in cells, are near an occupied one, the offset from its point, its normal."""
    rows, columns = table.shape
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    known = (column >= 0) & (row >= 0) & (column >> SHIFT < columns) & (row >> SHIFT < rows)
    column, row = np.where(known, column, 0), np.where(known, row, 0)
    tile = table[row >> SHIFT, column >> SHIFT]
    known &= tile >= 0
    code = owner[tile, ((row & MASK) << SHIFT) | (column & MASK)].astype(np.int64)
    known &= code > 0
    code = np.where(known, code - 1, REACH * SPAN + REACH)
    column, row = column + code % SPAN - REACH, row + code // SPAN - REACH
    tile = np.where(known, table[np.where(known, row >> SHIFT, 0), np.where(known, column >> SHIFT, 0)], 0)
    values = points[tile, ((row & MASK) << SHIFT) | (column & MASK)].astype(np.float64)
    return (
        known,
        x - column - 0.5 - values[..., 0],
        y - row - 0.5 - values[..., 1],
        values[..., 2],
        values[..., 3],
    )


def _evaluate_one(
    table: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    poses: Reals,
    settings: Reals,
) -> Reals:
    sigma, lsigma, resolution, first_x, first_y = settings
    x, y, yaw = poses[:, :, None].transpose(1, 0, 2)
    px = (x + np.cos(yaw) * beams[:, 0] - np.sin(yaw) * beams[:, 1]) / resolution - first_x
    py = (y + np.sin(yaw) * beams[:, 0] + np.cos(yaw) * beams[:, 1]) / resolution - first_y
    known, ex, ey, nx, ny = _nearest_numpy(table, points, owner, px, py)
    across = nx * ex + ny * ey
    along = nx * ey - ny * ex
    flat = (nx != 0) | (ny != 0)
    square = np.where(flat, across * across + ALONG * along * along, ex * ex + ey * ey) * resolution**2
    likelihoods = np.where(known, np.maximum(-square / lsigma, NULL_LIKELIHOOD), NULL_LIKELIHOOD)
    values = np.where(known, np.exp(-square / sigma), 0.0) if sigma > 0 else np.zeros_like(square)
    return np.column_stack((values.sum(axis=1), likelihoods.sum(axis=1)))


def _align_one(
    table: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    start: Reals,
    prior: Reals,
    information: Reals,
    settings: Reals,
) -> Reals:
    sigma, sharp, beam_information, iterations, resolution, first_x, first_y = settings
    pose = start.copy()
    shrink = (sharp / sigma) ** (1 / max(iterations / 2, 1))
    total = information.copy()
    matched = 0.0
    width = sigma
    for _ in range(int(iterations)):
        c, s = cos(pose[2]), sin(pose[2])
        rx, ry = c * beams[:, 0] - s * beams[:, 1], s * beams[:, 0] + c * beams[:, 1]
        known, ex, ey, nx, ny = _nearest_numpy(
            table, points, owner, (pose[0] + rx) / resolution - first_x, (pose[1] + ry) / resolution - first_y
        )
        ex, ey = ex * resolution, ey * resolution
        flat = (nx != 0) | (ny != 0)
        nx = np.where(flat, nx, 1.0)
        sideways = np.where(flat, ALONG, 1.0)
        across, along = nx * ex + ny * ey, nx * ey - ny * ex
        weight = np.where(known, np.exp(-(across**2 + sideways * along**2) / width), 0.0)
        matched = float(weight.sum())
        first = np.column_stack((nx, ny, ny * rx - nx * ry))
        second = np.column_stack((-ny, nx, nx * rx + ny * ry))
        w = weight * beam_information
        total = information + first.T @ (first * w[:, None]) + second.T @ (second * (w * sideways)[:, None])
        turned = prior - pose
        turned[2] = wrap(float(turned[2]))
        gradient = information @ turned - first.T @ (w * across) - second.T @ (w * sideways * along)
        step = solve(total, gradient)
        if advance(pose, step) and width <= sharp:
            break
        width = max(width * shrink, sharp)
    return np.concatenate((pose, total.ravel(), (matched,)))


def evaluate_numpy(
    tables: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    poses: Reals,
    settings: Reals,
) -> Reals:
    """Return scores and log-likelihoods; see :func:`rce_fleet.mapping.match_kernels.evaluate`."""
    return np.array(
        [
            _evaluate_one(table, points, owner, beams, p, settings)
            for table, p in zip(tables, poses, strict=True)
        ]
    )


def align_numpy(
    tables: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    starts: Reals,
    priors: Reals,
    informations: Reals,
    settings: Reals,
) -> Reals:
    """Return poses, information and weights; see :func:`rce_fleet.mapping.match_kernels.align`."""
    return np.array(
        [
            _align_one(table, points, owner, beams, start, prior, information, settings)
            for table, start, prior, information in zip(tables, starts, priors, informations, strict=True)
        ]
    )
