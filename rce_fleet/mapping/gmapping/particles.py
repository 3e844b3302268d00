"""Weights of particles, resampling, and the ways that particles came."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def normalized(log_weights: NDArray[np.float64], gain: float) -> NDArray[np.float64]:
    """Return weights, shape (N,), sum 1; log-weights are divided by ``gain * N``, as GMapping does."""
    weights = np.exp((log_weights - log_weights.max()) / (gain * len(log_weights)))
    return np.asarray(weights / weights.sum())


def effective_number(weights: NDArray[np.float64]) -> float:
    """Return how many particles of equal weight are worth as much (Liu 1996)."""
    return float(1 / (weights @ weights))


def entropy(weights: NDArray[np.float64]) -> float:
    """Return the entropy of weights that sum to 1, nats."""
    positive = weights[weights > 0]
    return float(-(positive * np.log(positive)).sum())


def systematic_sample(weights: NDArray[np.float64], draw: float) -> NDArray[np.int64]:
    """Return which particles survive, shape (N,): low-variance resampling (Thrun et al. 2005, table 4.4).

    Args:
        weights: shape (N,), sum 1.
        draw: Uniform random number, within 0 .. 1.
    """
    places = (np.arange(len(weights)) + draw) / len(weights)
    return np.minimum(np.searchsorted(np.cumsum(weights), places), len(weights) - 1).astype(np.int64)


class Ancestry:
    """The poses of all particles at all scans that were used, as a tree."""

    def __init__(self) -> None:
        self._poses: list[NDArray[np.float64]] = []
        self._parents: list[NDArray[np.int64]] = []

    def append(self, poses: NDArray[np.float64]) -> None:
        """Add the particles' poses, shape (N, 3), at the next scan."""
        self._poses.append(poses.copy())
        self._parents.append(np.arange(len(poses)))

    def choose(self, chosen: NDArray[np.int64]) -> None:
        """Note that the particles were replaced by copies of some of them."""
        self._parents[-1] = self._parents[-1][chosen]

    def path(self, particle: int) -> NDArray[np.float64]:
        """Return the poses on a particle's way, shape (scans, 3)."""
        path = np.empty((len(self._poses), 3))
        for number in range(len(self._poses) - 1, -1, -1):
            particle = int(self._parents[number][particle])
            path[number] = self._poses[number][particle]
        return path
