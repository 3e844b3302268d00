"""Matches scans with maps of tiles, compiled; see :mod:`rce_fleet.mapping.scan_matching`."""

from __future__ import annotations

from math import cos, exp, floor, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.mapping.match_numpy import ALONG, NULL_LIKELIHOOD, advance, align_numpy, evaluate_numpy, solve
from rce_fleet.mapping.tiles import MASK, REACH, SHIFT, SPAN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Reals = NDArray[np.float64]


@helper
def _nearest(
    table: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    x: float,
    y: float,
    found: Reals,
) -> bool:
    """Set the offset from the mean point of the nearest occupied cell, in cells, and its normal."""
    column = floor(x)
    row = floor(y)
    if column < 0 or row < 0 or column >> SHIFT >= table.shape[1] or row >> SHIFT >= table.shape[0]:
        return False
    tile = table[row >> SHIFT, column >> SHIFT]
    if tile < 0:
        return False
    code = int(owner[tile, ((row & MASK) << SHIFT) | (column & MASK)])
    if code == 0:
        return False
    column += (code - 1) % SPAN - REACH
    row += (code - 1) // SPAN - REACH
    tile = table[row >> SHIFT, column >> SHIFT]
    place = ((row & MASK) << SHIFT) | (column & MASK)
    found[0] = x - column - 0.5 - points[tile, place, 0]
    found[1] = y - row - 0.5 - points[tile, place, 1]
    found[2] = points[tile, place, 2]
    found[3] = points[tile, place, 3]
    return True


@helper
def _evaluate(
    table: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    poses: Reals,
    settings: Reals,
    result: Reals,
) -> None:
    """Set scores and log-likelihoods in one map."""
    sigma, lsigma, resolution = settings[0], settings[1], settings[2]
    found = np.zeros(4)
    for number in range(len(poses)):
        c = cos(poses[number, 2])
        s = sin(poses[number, 2])
        for i in range(len(beams)):
            px = (poses[number, 0] + c * beams[i, 0] - s * beams[i, 1]) / resolution - settings[3]
            py = (poses[number, 1] + s * beams[i, 0] + c * beams[i, 1]) / resolution - settings[4]
            if not _nearest(table, points, owner, px, py, found):
                result[number, 1] += NULL_LIKELIHOOD
                continue
            square = found[0] * found[0] + found[1] * found[1]
            if found[2] != 0 or found[3] != 0:
                across = found[2] * found[0] + found[3] * found[1]
                along = found[2] * found[1] - found[3] * found[0]
                square = across * across + ALONG * along * along
            square *= resolution * resolution
            if sigma > 0:
                result[number, 0] += exp(-square / sigma)
            result[number, 1] += max(-square / lsigma, NULL_LIKELIHOOD)


@helper
def _begin(pose: Reals, prior: Reals, information: Reals, total: Reals, gradient: Reals) -> None:
    """Set the normal equations to those of the prior."""
    turn = (prior[2] - pose[2] + np.pi) % (2 * np.pi) - np.pi
    for j in range(3):
        gradient[j] = (
            information[j, 0] * (prior[0] - pose[0])
            + information[j, 1] * (prior[1] - pose[1])
            + information[j, 2] * turn
        )
        for k in range(3):
            total[j, k] = information[j, k]


@helper
def _accumulate(
    jacobian: Reals, error: Reals, weight: float, sideways: float, total: Reals, gradient: Reals
) -> None:
    """Add a beam to the normal equations."""
    for j in range(3):
        gradient[j] -= weight * (jacobian[0, j] * error[0] + sideways * jacobian[1, j] * error[1])
        for k in range(3):
            total[j, k] += weight * (
                jacobian[0, j] * jacobian[0, k] + sideways * jacobian[1, j] * jacobian[1, k]
            )


@helper
def _align(
    table: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    start: Reals,
    prior: Reals,
    information: Reals,
    settings: Reals,
    result: Reals,
) -> None:
    """Set pose, information matrix and matched weight in one map."""
    resolution = settings[4]
    iterations = int(settings[3])
    shrink = (settings[1] / settings[0]) ** (1 / max(settings[3] / 2, 1.0))
    pose = start.copy()
    total = np.empty((3, 3))
    gradient = np.empty(3)
    found = np.zeros(4)
    jacobian = np.empty((2, 3))
    error = np.empty(2)
    matched = 0.0
    width = settings[0]
    for _ in range(iterations):
        c = cos(pose[2])
        s = sin(pose[2])
        matched = 0.0
        _begin(pose, prior, information, total, gradient)
        for i in range(len(beams)):
            rx = c * beams[i, 0] - s * beams[i, 1]
            ry = s * beams[i, 0] + c * beams[i, 1]
            px = (pose[0] + rx) / resolution - settings[5]
            py = (pose[1] + ry) / resolution - settings[6]
            if not _nearest(table, points, owner, px, py, found):
                continue
            nx, ny, sideways = found[2], found[3], ALONG
            if nx == 0 and ny == 0:
                nx, sideways = 1.0, 1.0
            error[0] = (nx * found[0] + ny * found[1]) * resolution
            error[1] = (nx * found[1] - ny * found[0]) * resolution
            jacobian[0, 0] = nx
            jacobian[0, 1] = ny
            jacobian[0, 2] = ny * rx - nx * ry
            jacobian[1, 0] = -ny
            jacobian[1, 1] = nx
            jacobian[1, 2] = nx * rx + ny * ry
            weight = exp(-(error[0] * error[0] + sideways * error[1] * error[1]) / width)
            matched += weight
            weight *= settings[2]
            _accumulate(jacobian, error, weight, sideways, total, gradient)
        step = solve(total, gradient)
        if advance(pose, step) and width <= settings[1]:
            break
        width = max(width * shrink, settings[1])
    result[:3] = pose
    for j in range(3):
        for k in range(3):
            result[3 + 3 * j + k] = total[j, k]
    result[12] = matched


@kernel(
    "float64[:,:,::1](int32[:,:,::1], float32[:,:,::1], uint8[:,::1], float64[:,::1], float64[:,:,::1],"
    " float64[::1])",
    numpy=evaluate_numpy,
)
def evaluate(
    tables: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    poses: Reals,
    settings: Reals,
) -> Reals:
    """Return scores and log-likelihoods of a scan at poses, in several maps.

    Args:
        tables: shape (maps, rows, columns), and the other arrays of a :class:`TileStore`.
        points: See TileStore.
        owner: See TileStore.
        beams: shape (N, 2): ends of the beams in the base's frame, metres.
        poses: shape (maps, M, 3).
        settings: sigma, lsigma (square metres), edge of a cell (metres), origin of the tables (column, row).

    Returns:
        shape (maps, M, 2).
    """
    result = np.zeros((len(tables), poses.shape[1], 2))
    for number in range(len(tables)):
        _evaluate(tables[number], points, owner, beams, poses[number], settings, result[number])
    return result


@kernel(
    "float64[:,::1](int32[:,:,::1], float32[:,:,::1], uint8[:,::1], float64[:,::1], float64[:,::1],"
    " float64[:,::1], float64[:,:,::1], float64[::1])",
    numpy=align_numpy,
)
def align(
    tables: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    beams: Reals,
    starts: Reals,
    priors: Reals,
    informations: Reals,
    settings: Reals,
) -> Reals:
    """Return where a scan fits best, in several maps.

    Args:
        tables: shape (maps, rows, columns), and the other arrays of a :class:`TileStore`.
        points: See TileStore.
        owner: See TileStore.
        beams: shape (N, 2): ends of the beams in the base's frame, metres.
        starts: shape (maps, 3): poses to begin at.
        priors: shape (maps, 3): poses by odometry.
        informations: shape (maps, 3, 3): their inverse covariances.
        settings: first and last width of the weights (square metres), information of a beam, steps, edge of a
            cell (metres), origin of the tables (column, row).

    Returns:
        shape (maps, 13): pose, information matrix, sum of the weights.
    """
    result = np.empty((len(tables), 13))
    for number in range(len(tables)):
        _align(
            tables[number],
            points,
            owner,
            beams,
            starts[number],
            priors[number],
            informations[number],
            settings,
            result[number],
        )
    return result
