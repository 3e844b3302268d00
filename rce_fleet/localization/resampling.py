"""Choosing particles by their weights, as many as the spread of the distribution needs.

The number of particles follows KLD sampling: Fox, "Adapting the sample size in particle filters through
KLD-sampling", IJRR 22 (2003), equation 14, with the bins of ROS's ``amcl``.
"""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.localization.parameters import AmclParameters

BIN_M = 0.5
"""Edge of a bin, metres."""
BIN_RAD = pi / 18
"""Width of a bin of headings, radians."""
HEADINGS = round(2 * pi / BIN_RAD)
_ROWS = 1 << 24
_LEAST_POWER = 1e-9


def bin_numbers(particles: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return a number for the bin of each particle, shape (N,).

    Args:
        particles: shape (3, N): x, y, yaw; x and y within 4000 km.
    """
    column = np.floor(particles[0] / BIN_M).astype(np.int64)
    row = np.floor(particles[1] / BIN_M).astype(np.int64)
    heading = np.floor(particles[2] / BIN_RAD).astype(np.int64) % HEADINGS
    return np.asarray((row * _ROWS + column) * HEADINGS + heading)


def split_bins(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return column, row and heading of bins, shape (3, N)."""
    places, heading = np.divmod(numbers, HEADINGS)
    row = (places + _ROWS // 2) // _ROWS
    return np.stack((places - row * _ROWS, row, heading))


def particles_needed(bins: NDArray[np.int64] | int, parameters: AmclParameters) -> NDArray[np.int64]:
    """Return how many particles are needed for distributions over so many bins; the minimum for one bin."""
    k = np.asarray(bins, np.float64)
    below = np.maximum(k - 1, 1)
    b = 2 / (9 * below)
    needed = np.ceil(below / (2 * parameters.kld_err) * (1 - b + np.sqrt(b) * parameters.kld_z) ** 3)
    return np.clip(
        np.where(k > 1, needed, parameters.min_particles), parameters.min_particles, parameters.max_particles
    ).astype(np.int64)


def count_for(drawn: NDArray[np.int64], parameters: AmclParameters) -> int | None:
    """Return after how many of the drawn particles KLD sampling stops; None if more have to be drawn.

    Args:
        drawn: shape (M,): bins of particles in the order in which they were drawn.
        parameters: Limits of the number, ``kld_err`` and ``kld_z``.
    """
    _, firsts = np.unique(drawn, return_index=True)
    firsts.sort()
    # After drawing particle firsts[j] there are j + 1 bins, until particle firsts[j + 1].
    needed = particles_needed(np.arange(1, len(firsts) + 1), parameters)
    stops = np.maximum(needed, firsts + 1)
    until = np.append(firsts[1:], len(drawn))
    reached = np.flatnonzero(stops <= until)
    return int(stops[reached[0]]) if len(reached) else None


def systematic(weights: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Choose ``count`` particles by low-variance sampling (Probabilistic Robotics, table 4.4).

    Args:
        weights: shape (N,), normalized.
        count: How many.
        rng: Draws one number.

    Returns:
        shape (count,): indexes, ascending.
    """
    sums = np.cumsum(weights)
    places = (np.arange(count) + rng.random()) * (sums[-1] / count)
    return np.asarray(np.minimum(np.searchsorted(sums, places, side="right"), len(weights) - 1), np.intp)


def resample(
    particles: NDArray[np.float64],
    weights: NDArray[np.float64],
    parameters: AmclParameters,
    rng: np.random.Generator,
) -> NDArray[np.intp]:
    """Choose particles by their weights, as many as KLD sampling needs.

    Independent draws find the number; a systematic draw of this number has less variance.

    Args:
        particles: shape (3, N).
        weights: shape (N,), normalized.
        parameters: Limits of the number, ``kld_err`` and ``kld_z``.
        rng: Draws them.

    Returns:
        shape (M,): indexes.
    """
    bins = bin_numbers(particles)
    sums = np.cumsum(weights)
    drawn = np.empty(0, np.int64)
    chunk = min(max(2 * parameters.min_particles, len(weights)), parameters.max_particles)
    while True:
        picks = np.searchsorted(sums, rng.random(chunk) * sums[-1], side="right")
        drawn = np.concatenate((drawn, bins[np.minimum(picks, len(bins) - 1)]))
        count = count_for(drawn, parameters)
        if count is not None or len(drawn) >= parameters.max_particles:
            break
        chunk = min(len(drawn), parameters.max_particles - len(drawn))
    return systematic(weights, count or parameters.max_particles, rng)


def effective_count(weights: NDArray[np.float64]) -> float:
    """Return the effective number of particles of normalized weights."""
    return 1.0 / float(weights @ weights)


def temper(weights: NDArray[np.float64], logs: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Return weights multiplied by likelihoods, or by a root of them if few particles would keep any weight.

    Args:
        weights: shape (N,), normalized.
        logs: shape (N,): logarithms of the likelihoods.
        least: Share of the effective number of particles that must remain.

    Returns:
        shape (N,), normalized.
    """
    logs = logs - logs.max()
    wanted = min(least * len(weights), effective_count(weights))
    made = _times(weights, logs)
    if effective_count(made) >= wanted:
        return made
    low = 1.0
    while low > _LEAST_POWER and effective_count(_times(weights, low * logs)) < wanted:
        low /= 2
    high = 2 * low
    for _ in range(4):
        middle = (low + high) / 2
        if effective_count(_times(weights, middle * logs)) >= wanted:
            low = middle
        else:
            high = middle
    return _times(weights, low * logs)


def _times(weights: NDArray[np.float64], logs: NDArray[np.float64]) -> NDArray[np.float64]:
    made = weights * np.exp(logs)
    made /= made.sum()
    return made
