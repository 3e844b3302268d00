"""Matches scans with maps of tiles: how well a scan fits at poses, and the poses where it fits best.

A beam's end is compared with the mean point of the nearest occupied cell: across the wall, where the points
there form a line, and in all directions otherwise (point-to-line matching: Censi, "An ICP variant using a
point-to-line metric", 2008). Ends with no occupied cell within reach do not pull.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap_array
from rce_fleet.mapping.match_kernels import align, evaluate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.tiles import TileStore

    Reals = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Matches:
    """Where a scan fits best in each of some maps.

    Attributes:
        poses: shape (maps, 3): x, y, yaw of the base.
        information: shape (maps, 3, 3): inverse covariances of the poses, with those of the priors.
        matched: shape (maps,): sum of the weights of beams that met a wall, at most the number of beams.
    """

    poses: Reals
    information: Reals
    matched: Reals


def scores(
    store: TileStore, maps: slice, beams: Reals, poses: Reals, *, sigma: float = 0.0, lsigma: float = 1.0
) -> Reals:
    """Return how well a scan fits at poses in maps.

    Args:
        store: The maps.
        maps: Which of them.
        beams: shape (N, 2): ends of the beams in the base's frame, metres.
        poses: shape (maps, M, 3).
        sigma: Width of the score, square metres: a beam counts ``exp(-d * d / sigma)``, as in GMapping.
            With 0 the score is not computed, and is 0.
        lsigma: The same for the log-likelihood, at least -0.5 a beam.

    Returns:
        shape (maps, M, 2): scores, within 0 .. N, and log-likelihoods.
    """
    settings = np.array((sigma, lsigma, store.resolution, *store.origin), np.float64)
    return evaluate(
        store.tables[maps], store.points, store.owner, beams, np.ascontiguousarray(poses), settings
    )


def match(
    store: TileStore,
    maps: slice,
    beams: Reals,
    starts: Reals,
    priors: Reals,
    information: Reals,
    *,
    sigma: float,
    sharp: float = 0.01,
    beam_std: float = 0.1,
    iterations: int = 20,
) -> Matches:
    """Return the poses near the starts at which a scan fits maps best, given what odometry says.

    Gauss-Newton with weights ``exp(-d * d / sigma)``; ``sigma`` shrinks to ``sharp`` on the way.

    Args:
        store: The maps.
        maps: Which of them.
        beams: shape (N, 2): ends of the beams in the base's frame, metres.
        starts: shape (maps, 3): poses to begin at.
        priors: shape (maps, 3): poses by odometry.
        information: shape (maps, 3, 3): inverse covariances of the priors.
        sigma: Width of the weights at the beginning, square metres.
        sharp: Width at the end, square metres.
        beam_std: Standard deviation of a beam, metres; larger than the laser's, as neighbouring beams are not
            independent.
        iterations: Most steps.
    """
    settings = np.array(
        (sigma, sharp, 1 / beam_std**2, iterations, store.resolution, *store.origin), np.float64
    )
    found = align(
        store.tables[maps],
        store.points,
        store.owner,
        beams,
        np.ascontiguousarray(starts, np.float64),
        np.ascontiguousarray(priors, np.float64),
        np.ascontiguousarray(information, np.float64),
        settings,
    )
    poses = found[:, :3].copy()
    poses[:, 2] = wrap_array(poses[:, 2])
    return Matches(poses, found[:, 3:12].reshape(-1, 3, 3), found[:, 12])
