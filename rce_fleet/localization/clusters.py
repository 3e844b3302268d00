"""The pose that particles stand for: the mean of their heaviest cluster, with its covariance.

Particles are in one cluster if their bins touch, also over a corner, as in ROS's ``amcl``; unlike there,
headings of -180 and 180 degrees touch too.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from rce_fleet.geometry.angles import wrap_array
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.resampling import HEADINGS, bin_numbers, split_bins

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FEW = 200
"""Up to so many bins are compared with each other; more are looked up among their neighbours."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A place where the robot may be.

    Attributes:
        pose: Mean pose of the cluster's particles.
        covariance: shape (3, 3), of x, y (metres) and yaw (radians).
        weight: Share of the particles' weight, 0 .. 1.
    """

    pose: Pose
    covariance: NDArray[np.float64]
    weight: float


def find_hypotheses(
    particles: NDArray[np.float64], weights: NDArray[np.float64], *, most: int = 10
) -> list[Hypothesis]:
    """Return the heaviest clusters of particles, the heaviest first.

    Args:
        particles: shape (3, N), N at least 1.
        weights: shape (N,), normalized.
        most: So many clusters at most.
    """
    numbers, members = np.unique(bin_numbers(particles), return_inverse=True)
    if len(numbers) == 1:
        return [_hypothesis(particles, weights)]
    count, labels = _connected(split_bins(numbers))
    if count == 1:
        return [_hypothesis(particles, weights)]
    cluster = labels[members]
    shares = np.bincount(cluster, weights, count)
    heaviest = np.argsort(-shares, kind="stable")[:most]
    found = []
    for label in heaviest[shares[heaviest] > 0]:
        inside = np.flatnonzero(cluster == label)
        found.append(_hypothesis(particles[:, inside], weights[inside]))
    return found


def _hypothesis(particles: NDArray[np.float64], weights: NDArray[np.float64]) -> Hypothesis:
    total = float(weights.sum())
    share = weights / total
    x, y = particles[0] @ share, particles[1] @ share
    yaw = atan2(float(np.sin(particles[2]) @ share), float(np.cos(particles[2]) @ share))
    off = np.stack((particles[0] - x, particles[1] - y, wrap_array(particles[2] - yaw)))
    return Hypothesis(Pose(float(x), float(y), yaw), (off * share) @ off.T, total)


def _connected(bins: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """Return the number of clusters of bins, shape (3, B), and the cluster of each."""
    if bins.shape[1] <= _FEW:
        apart = np.abs(bins[:, :, None] - bins[:, None, :])
        apart[2] = np.minimum(apart[2], HEADINGS - apart[2])
        touching = (apart <= 1).all(axis=0)
        labels = np.arange(len(touching))
        while True:  # each bin takes the least label among those it touches
            least = np.where(touching, labels, len(labels)).min(axis=1)
            if (least == labels).all():
                break
            labels = least
        kept, labels = np.unique(labels, return_inverse=True)
        return len(kept), labels
    graph = _graph(bins)
    count, labels = csgraph.connected_components(graph, directed=False)
    return int(count), np.asarray(labels, np.int64)


def _graph(bins: NDArray[np.int64]) -> sparse.coo_array:
    """Return which bins touch, looked up by their numbers in a dense numbering of the bounding box."""
    low = bins[:2].min(axis=1, keepdims=True) - 1
    column, row = bins[:2] - low
    width = int(column.max()) + 2
    keys = (row * width + column) * HEADINGS + bins[2]
    order = np.argsort(keys)
    ordered = keys[order]
    first, second = [], []
    steps = [(dc, dr, dh) for dc in (-1, 0, 1) for dr in (-1, 0, 1) for dh in (-1, 0, 1)]
    for dc, dr, dh in steps[: len(steps) // 2]:  # the other half are the same pairs
        wanted = ((row + dr) * width + column + dc) * HEADINGS + (bins[2] + dh) % HEADINGS
        places = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
        there = np.flatnonzero(ordered[places] == wanted)
        first.append(there)
        second.append(order[places[there]])
    a, b = np.concatenate(first), np.concatenate(second)
    return sparse.coo_array((np.ones(len(a), np.int8), (a, b)), shape=(len(keys), len(keys)))
