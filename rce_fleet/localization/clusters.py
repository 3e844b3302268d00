"""The pose that particles stand for: the mean of their heaviest cluster, with its covariance.

Particles are in one cluster if their bins touch, also over a corner, as in ROS's ``amcl``; unlike there,
headings of -180 and 180 degrees touch too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from rce_fleet.compiled import kernel
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.resampling import HEADINGS, bin_numbers, distinct, split_bins

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
    numbers, members = distinct(bin_numbers(particles))
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
    found = moments(np.ascontiguousarray(particles), weights)
    pose = Pose(float(found[1]), float(found[2]), float(found[3]))
    return Hypothesis(pose, found[4:].reshape(3, 3), float(found[0]))


def _moments_numpy(particles: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    total = weights.sum()
    share = weights / total
    x, y = particles[0] @ share, particles[1] @ share
    yaw = np.arctan2(np.sin(particles[2]) @ share, np.cos(particles[2]) @ share)
    off = np.empty_like(particles)
    off[0], off[1] = particles[0] - x, particles[1] - y
    off[2] = (particles[2] - yaw + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate(((total, x, y, yaw), ((off * share) @ off.T).reshape(-1)))


@kernel("float64[::1](float64[:,::1], float64[::1])", numpy=_moments_numpy)
def moments(particles: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return total weight, mean x, y and yaw, and the covariance row by row of particles: shape (13,).

    Args:
        particles: shape (3, N).
        weights: shape (N,).
    """
    count = particles.shape[1]
    total = x = y = c = s = 0.0
    for i in range(count):
        total += weights[i]
        x += weights[i] * particles[0, i]
        y += weights[i] * particles[1, i]
        c += weights[i] * np.cos(particles[2, i])
        s += weights[i] * np.sin(particles[2, i])
    found = np.zeros(13)
    found[0], found[1], found[2], found[3] = total, x / total, y / total, np.arctan2(s, c)
    off = np.empty(3)
    for i in range(count):
        off[0], off[1] = particles[0, i] - found[1], particles[1, i] - found[2]
        off[2] = (particles[2, i] - found[3] + np.pi) % (2 * np.pi) - np.pi
        for row in range(3):
            for column in range(3):
                found[4 + 3 * row + column] += weights[i] / total * off[row] * off[column]
    return found


def _connected(bins: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """Return the number of clusters of bins, shape (3, B), and the cluster of each."""
    if bins.shape[1] <= _FEW:
        labels = label_few(np.ascontiguousarray(bins))
        return int(labels.max()) + 1, labels
    graph = _graph(bins)
    count, labels = csgraph.connected_components(graph, directed=False)
    return int(count), np.asarray(labels, np.int64)


def _label_numpy(bins: NDArray[np.int64]) -> NDArray[np.int64]:
    apart = np.abs(bins[:, :, None] - bins[:, None, :])
    apart[2] = np.minimum(apart[2], HEADINGS - apart[2])
    touching = (apart <= 1).all(axis=0)
    labels = np.arange(len(touching))
    while True:  # each bin takes the least label among those it touches
        least = np.where(touching, labels, len(labels)).min(axis=1)
        if (least == labels).all():
            return np.asarray(np.unique(labels, return_inverse=True)[1], np.int64)
        labels = least


@kernel("int64[::1](int64[:,::1])", numpy=_label_numpy)
def label_few(bins: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cluster of each of a few bins, shape (B,): 0, 1, ... in the order of their first bins.

    Args:
        bins: shape (3, B): column, row, heading.
    """
    count = bins.shape[1]
    labels = np.full(count, -1, np.int64)
    waiting = np.empty(count, np.int64)
    clusters = 0
    for first in range(count):
        if labels[first] >= 0:
            continue
        labels[first] = clusters
        waiting[0] = first
        size = 1
        while size:
            size -= 1
            here = waiting[size]
            for other in range(count):
                turn = abs(bins[2, here] - bins[2, other])
                if (
                    labels[other] < 0
                    and abs(bins[0, here] - bins[0, other]) <= 1
                    and abs(bins[1, here] - bins[1, other]) <= 1
                    and min(turn, HEADINGS - turn) <= 1
                ):
                    labels[other] = clusters
                    waiting[size] = other
                    size += 1
        clusters += 1
    return labels


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
