"""Choosing particles by their weights, as many as the spread of the distribution needs.

The number of particles follows KLD sampling: Fox, "Adapting the sample size in particle filters through
KLD-sampling", IJRR 22 (2003), equation 14, with the bins of ROS's ``amcl``.
"""

from __future__ import annotations

from functools import lru_cache
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel

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
_FEW = 64


def _bins_numpy(particles: NDArray[np.float64]) -> NDArray[np.int64]:
    column = np.floor(particles[0] * (1 / BIN_M)).astype(np.int64)
    row = np.floor(particles[1] * (1 / BIN_M)).astype(np.int64)
    heading = np.floor(particles[2] * (1 / BIN_RAD)).astype(np.int64) % HEADINGS
    return np.asarray((row * _ROWS + column) * HEADINGS + heading)


@kernel("int64[::1](float64[:,::1])", numpy=_bins_numpy)
def _bins_loop(particles: NDArray[np.float64]) -> NDArray[np.int64]:
    numbers = np.empty(particles.shape[1], np.int64)
    for i in range(particles.shape[1]):
        column = int(np.floor(particles[0, i] * (1 / BIN_M)))
        row = int(np.floor(particles[1, i] * (1 / BIN_M)))
        heading = int(np.floor(particles[2, i] * (1 / BIN_RAD))) % HEADINGS
        numbers[i] = (row * _ROWS + column) * HEADINGS + heading
    return numbers


def bin_numbers(particles: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return a number for the bin of each particle, shape (N,).

    Args:
        particles: shape (3, N): x, y, yaw; x and y within 4000 km.
    """
    return _bins_loop(np.ascontiguousarray(particles))


def _distinct_numpy(bins: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    numbers, members = np.unique(bins, return_inverse=True)
    return numbers, np.asarray(members, np.int64)


@kernel("Tuple((int64[::1], int64[::1]))(int64[::1])", numpy=_distinct_numpy)
def distinct(bins: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the different bins, ascending, and which of them each particle is in: shapes (B,), (N,).

    Args:
        bins: shape (N,), N at least 1.
    """
    members = np.empty(len(bins), np.int64)
    few = np.empty(_FEW, np.int64)
    found = 0
    for i in range(len(bins)):  # mostly there are few, and a search beats sorting
        at = 0
        while at < found and few[at] != bins[i]:
            at += 1
        if at == found:
            if found == _FEW:
                found += 1
                break
            few[found] = bins[i]
            found += 1
        members[i] = at
    if found <= _FEW:
        order = np.argsort(few[:found])
        place = np.empty(found, np.int64)
        for at in range(found):
            place[order[at]] = at
        for i in range(len(bins)):
            members[i] = place[members[i]]
        return few[:found][order], members
    order = np.argsort(bins)
    numbers = np.empty(len(bins), np.int64)
    count = 0
    for at in range(len(bins)):
        if at == 0 or bins[order[at]] != bins[order[at - 1]]:
            numbers[count] = bins[order[at]]
            count += 1
        members[order[at]] = count - 1
    return numbers[:count].copy(), members


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


@lru_cache(maxsize=8)
def _needed_table(parameters: AmclParameters) -> NDArray[np.int64]:
    """Return :func:`particles_needed` for 0, 1, 2, ... bins, until it is the maximum."""
    bins = 64
    while True:
        needed = particles_needed(np.arange(bins), parameters)
        if needed[-1] == parameters.max_particles:
            return needed[: int(np.argmax(needed == parameters.max_particles)) + 1]
        bins *= 4


def _stop_numpy(
    members: NDArray[np.int64],
    sums: NDArray[np.float64],
    draws: NDArray[np.float64],
    needed: NDArray[np.int64],
) -> int:
    picks = np.minimum(np.searchsorted(sums, draws * sums[-1], side="right"), len(members) - 1)
    _, firsts = np.unique(members[picks], return_index=True)
    firsts.sort()
    # After drawing particle firsts[j] there are j + 1 bins, until particle firsts[j + 1].
    wanted = needed[np.minimum(np.arange(1, len(firsts) + 1), len(needed) - 1)]
    stops = np.maximum(wanted, firsts + 1)
    until = np.append(firsts[1:], len(draws))
    reached = np.flatnonzero(stops <= until)
    return int(stops[reached[0]]) if len(reached) else -1


@kernel("int64(int64[::1], float64[::1], float64[::1], int64[::1])", numpy=_stop_numpy)
def stop_of_draws(
    members: NDArray[np.int64],
    sums: NDArray[np.float64],
    draws: NDArray[np.float64],
    needed: NDArray[np.int64],
) -> int:
    """Return after how many draws KLD sampling stops; -1 if more draws are needed.

    Args:
        members: shape (N,): number of each particle's bin, from 0.
        sums: shape (N,): cumulative weights.
        draws: shape (M,): random numbers, 0 .. 1.
        needed: Particles needed for 0, 1, 2, ... bins; the last for more bins too.
    """
    seen = np.zeros(members.max() + 1, np.bool_)
    found = 0
    for i in range(len(draws)):
        pick = min(np.searchsorted(sums, draws[i] * sums[-1], side="right"), len(members) - 1)
        if not seen[members[pick]]:
            seen[members[pick]] = True
            found += 1
        if i + 1 >= needed[min(found, len(needed) - 1)]:
            return i + 1
    return -1


def _systematic_numpy(sums: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    places = (np.arange(count) + offset) * (sums[-1] / count)
    return np.asarray(np.minimum(np.searchsorted(sums, places, side="right"), len(sums) - 1), np.int64)


@kernel("int64[::1](float64[::1], int64, float64)", numpy=_systematic_numpy)
def _systematic_loop(sums: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    chosen = np.empty(count, np.int64)
    step, at, last = sums[-1] / count, 0, len(sums) - 1
    for i in range(count):
        place = (i + offset) * step
        while at < last and sums[at] <= place:
            at += 1
        chosen[i] = at
    return chosen


def systematic(weights: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose ``count`` particles by low-variance sampling (Probabilistic Robotics, table 4.4).

    Args:
        weights: shape (N,), normalized.
        count: How many.
        rng: Draws one number.

    Returns:
        shape (count,): indexes, ascending.
    """
    return _systematic_loop(np.cumsum(weights), count, float(rng.random()))


def resample(
    particles: NDArray[np.float64],
    weights: NDArray[np.float64],
    parameters: AmclParameters,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
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
    most = parameters.max_particles
    count = most
    if parameters.min_particles < most:
        _, members = distinct(bin_numbers(particles))
        sums, needed = np.cumsum(weights), _needed_table(parameters)
        draws = rng.random(min(max(2 * parameters.min_particles, len(weights)), most))
        while (count := stop_of_draws(members, sums, draws, needed)) < 0:
            if len(draws) >= most:
                count = most
                break
            draws = np.concatenate((draws, rng.random(min(len(draws), most - len(draws)))))
    return systematic(weights, count, rng)


def effective_count(weights: NDArray[np.float64]) -> float:
    """Return the effective number of particles of normalized weights."""
    return 1.0 / float(weights @ weights)


def temper(weights: NDArray[np.float64], logs: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Return weights multiplied by likelihoods, or by a root of them if few particles would keep any weight.

    Args:
        weights: shape (N,), normalized; some may be 0.
        logs: shape (N,): logarithms of the likelihoods.
        least: Share of the effective number of particles that must remain.

    Returns:
        shape (N,), normalized.
    """
    # Those without weight count for nothing, however likely they are: all others could become 0 beside them.
    logs = np.minimum(logs - logs[weights > 0].max(), 0.0)
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
