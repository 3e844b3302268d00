"""A Rao-Blackwellized particle filter for grid maps.

Grisetti, Stachniss, Burgard, "Improved Techniques for Grid Mapping with Rao-Blackwellized Particle
Filters", IEEE Transactions on Robotics 23, 2007: each particle has a map of its own; its next pose is drawn
from a Gaussian around the best match of the scan in that map (section IV), and particles are drawn anew only
if their effective number is small (section V).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import hypot, inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import circular_mean, wrap_array
from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.gmapping.motion import LEAST_STD, motion_std, prior_information
from rce_fleet.mapping.gmapping.particles import (
    Ancestry,
    effective_number,
    entropy,
    normalized,
    systematic_sample,
)
from rce_fleet.mapping.occupancy_mapping import beams_of, draw_record
from rce_fleet.mapping.scan_matching import Matches, match, scores
from rce_fleet.mapping.tiles import TileStore

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.gmapping.parameters import FilterParameters
    from rce_fleet.mapping.records import LaserRecord

    Reals = NDArray[np.float64]

STEPS_PER_ITERATION = 2
COARSE_BEAMS = 60
"""Beams of the coarse search."""
COARSE_SHARP = 2.0
"""How much narrower than ``lsigma`` says the likelihood of the coarse search is."""
SHARP = 4.0
"""How much narrower the likelihood is with which the coarse search's result is compared with odometry's."""
LEAST_MATCHED = 0.1
"""A match in which a smaller share of the beams met a wall is refused."""
TEMPER = 0.2
"""How much a beam counts against odometry: neighbouring beams are not independent."""
DOUBT = 8.0
"""Squared normalized error from which odometry is doubted rather than believed more strictly."""


def _samples(reach: float, step: float) -> Reals:
    """Return offsets up to a reach to both sides of 0."""
    number = int(reach / step + 1e-9)
    return np.arange(-number, number + 1, dtype=np.float64) * step


OFFSETS = np.array(list(product(_samples(0.3, 0.15), _samples(0.3, 0.15), _samples(0.35, 0.05))))
"""Errors of odometry since the last scan that are tried, shape (K, 3): metres, radians."""


def _doubtful(error: Reals, std: Reals) -> Reals:
    """Return the log-likelihood of errors of odometry, shape (..., 3); at least ``-DOUBT / 2``."""
    square = ((error / std) ** 2).sum(axis=-1)
    return np.asarray(-0.5 * square / (1 + square / DOUBT))


@dataclass(frozen=True, slots=True)
class _Scan:
    """A scan as the filter needs it: ends of the beams that are matched, in the base's frame."""

    record: LaserRecord
    beams: Reals
    coarse: Reals
    likely: Reals


class GridFilter:
    """The filter.

    Args:
        parameters: GMapping's.
        rng: Source of randomness; the same seed gives the same result.
        start: Pose of the first scan on the map, shape (3,).
        keeps_way: Keep where the particles were at each scan.

    Attributes:
        poses: shape (particles, 3): x, y, yaw.
        weights: shape (particles,), sum 1.
        store: The particles' maps.
    """

    def __init__(
        self,
        parameters: FilterParameters,
        rng: np.random.Generator,
        start: tuple[float, ...] = (0.0, 0.0, 0.0),
        *,
        keeps_way: bool = True,
    ) -> None:
        number = parameters.particles
        self.parameters = parameters
        self.poses = np.tile(np.asarray(start, np.float64), (number, 1))
        self.weights = np.full(number, 1 / number)
        self.store = TileStore(number, parameters.delta)
        self.ancestry = Ancestry()
        self._keeps_way = keeps_way
        self._log_weights = np.zeros(number)
        self._rng = rng
        self._odometry: Reals | None = None
        self._jumped = False
        self._base = self.poses[0].copy()
        self._motion = np.zeros(3)
        self._driven = np.zeros(3)
        self._time = 0.0

    @property
    def best(self) -> int:
        """Number of the particle with the greatest weight."""
        return int(self.weights.argmax())

    @property
    def effective(self) -> float:
        """Effective number of particles."""
        return effective_number(self.weights)

    @property
    def entropy(self) -> float:
        """Entropy of the weights, nats."""
        return entropy(self.weights)

    def farthest(self, record: LaserRecord) -> float:
        """Return up to where readings of a scan are used, metres."""
        return self.parameters.max_usable_range or self.parameters.max_range or record.range_max

    @property
    def estimate(self) -> Reals:
        """The best particle's pose at the last scan that was added, used or not, shape (3,)."""
        return compose(self.poses[self.best], self._motion)

    @property
    def covariance(self) -> Reals:
        """Covariance of the particles' poses, shape (3, 3)."""
        spread = self.poses.copy()
        # Headings on both sides of pi are close to each other.
        spread[:, 2] = wrap_array(spread[:, 2] - circular_mean(spread[:, 2], self.weights))
        return np.cov(spread.T, aweights=self.weights, ddof=0).reshape(3, 3)

    @property
    def tracked(self) -> Reals:
        """Odometry as corrected by matching each scan with what was seen just before, shape (3,)."""
        return compose(self._base, self._motion)

    def add(self, record: LaserRecord) -> bool:
        """Use a scan: to track the motion, and if the robot has moved enough, to update the particles.

        Returns:
            Whether the particles were updated.

        Raises:
            MapError: If a map would become larger than any floor: odometry or readings are wrong.
        """
        odometry = np.array(record.odometry)
        scan = self._prepare(record)
        if self._odometry is not None:
            step = np.zeros(3) if self._jumped else relative(self._odometry, odometry)
            self._jumped = False
            self._driven = compose(self._driven, step)
            self._motion = self._track(scan, compose(self._motion, step), motion_std(step, self.parameters))
            self._odometry = odometry
            if not self._is_due(record):
                return False
            self._move(scan, self._motion, motion_std(self._driven, self.parameters))
        self._base = self.tracked
        self._odometry, self._time = odometry, record.time
        self._motion, self._driven = np.zeros(3), np.zeros(3)
        if not self._keeps_way:
            self.ancestry = Ancestry()
        self.ancestry.append(self.poses)
        self.weights = normalized(self._log_weights, self.parameters.gain)
        if self.effective < self.parameters.resample_threshold * len(self.poses):
            self._resample()
        draw_record(self.store, record, self.poses, self.farthest(record))
        return True

    def _is_due(self, record: LaserRecord) -> bool:
        """Return whether the robot has moved enough, or enough time has passed, to update the particles."""
        p = self.parameters
        return (
            hypot(self._motion[0], self._motion[1]) >= p.linear_update
            or abs(self._motion[2]) >= p.angular_update
            or 0 <= p.temporal_update <= record.time - self._time
        )

    def forget_odometry(self) -> None:
        """Take the next scan's odometry as that of the last one: it jumped, and does not tell the way."""
        self._jumped = True

    def path(self) -> Reals:
        """Return the poses of the best particle at the scans that were used, shape (K, 3).

        Without ``keeps_way``, this is its pose at the last one.
        """
        return self.ancestry.path(self.best)

    def _prepare(self, record: LaserRecord) -> _Scan:
        _, ends, hit = beams_of(record, self.farthest(record))
        beams = np.ascontiguousarray(ends[hit])
        coarse = np.ascontiguousarray(beams[:: max(-(-len(beams) // COARSE_BEAMS), 1)])
        return _Scan(record, beams, coarse, np.ascontiguousarray(beams[:: self.parameters.skip + 1]))

    def _track(self, scan: _Scan, motion: Reals, std: Reals) -> Reals:
        """Return the motion since the last update, corrected by matching with the best particle's map.

        Odometry may be wrong by more than its model says (wheels slip; some robots report backward motion as
        forward), so a better fit elsewhere outweighs it.

        Args:
            scan: The scan.
            motion: shape (3,): the motion by odometry since the last scan.
            std: shape (3,): standard deviations of odometry since the last scan.
        """
        if not len(scan.beams):
            return motion
        maps = slice(self.best, self.best + 1)
        pose = self.poses[maps]
        std = np.maximum(std, LEAST_STD)
        offset = self._coarse_offset(scan, motion, std)
        best, best_value = motion, -inf
        for start in (np.zeros(3), offset) if offset.any() else (offset,):
            expected = compose(pose, motion + start)
            found, accepted = self._match(maps, scan, expected, prior_information(expected[:, 2], std))
            moved = relative(pose[0], found.poses[0])
            value = TEMPER * self._likelihoods(maps, scan.beams, found.poses[:, None], SHARP)[0, 0]
            value += float(_doubtful(moved - motion, std))
            if accepted[0] and value > best_value:
                best, best_value = moved, value
        return best

    def _match(
        self, maps: slice, scan: _Scan, expected: Reals, information: Reals
    ) -> tuple[Matches, NDArray[np.bool_]]:
        """Return matches near expected poses, and which of them are good enough to be used."""
        p = self.parameters
        steps = STEPS_PER_ITERATION * p.iterations
        found = match(
            self.store, maps, scan.beams, expected, expected, information, sigma=p.sigma, iterations=steps
        )
        values = scores(self.store, maps, scan.beams, found.poses[:, None], sigma=p.sigma)[:, 0, 0]
        return found, (values > p.minimum_score) & (values >= LEAST_MATCHED * len(scan.beams))

    def _move(self, scan: _Scan, motion: Reals, std: Reals) -> None:
        """Draw the poses after a motion from the Gaussians around the matches, or by odometry."""
        noise = self._rng.normal(size=(len(self.poses), 3))
        by_odometry = compose(self.poses, motion + std * noise)
        if not len(scan.beams):
            self.poses = by_odometry
            return
        expected = compose(self.poses, motion)
        found, accepted = self._match(slice(None), scan, expected, prior_information(self.poses[:, 2], std))
        drawn = found.poses
        if len(self.poses) > 1:
            roots = np.linalg.cholesky(np.linalg.inv(found.information))
            drawn = drawn + (roots @ noise[:, :, None])[:, :, 0]
        self.poses = np.where(accepted[:, None], drawn, by_odometry)
        self.poses[:, 2] = wrap_array(self.poses[:, 2])
        self._log_weights += self._log_likelihoods(scan.likely)

    def _likelihoods(self, maps: slice, beams: Reals, poses: Reals, sharpness: float = 1.0) -> Reals:
        return scores(self.store, maps, beams, poses, lsigma=self.parameters.lsigma / sharpness)[:, :, 1]

    def _log_likelihoods(self, beams: Reals) -> Reals:
        """Return the mean likelihoods of a scan at the poses around each particle's, as logarithms."""
        p = self.parameters
        steps = (p.ll_sample_step, p.ll_sample_step, p.la_sample_step)
        reach = (p.ll_sample_range, p.ll_sample_range, p.la_sample_range)
        around = [np.zeros((1, 3))]
        for axis in range(3):
            line = np.zeros((len(_samples(reach[axis], steps[axis])), 3))
            line[:, axis] = _samples(reach[axis], steps[axis])
            around.append(line[line[:, axis] != 0])
        poses = self.poses[:, None] + np.vstack(around)
        values = self._likelihoods(slice(None), beams, poses)
        most = values.max(axis=1)
        return np.asarray(most + np.log(np.exp(values - most[:, None]).mean(axis=1)))

    def _coarse_offset(self, scan: _Scan, motion: Reals, std: Reals) -> Reals:
        """Return how wrong odometry's motion is, from a grid of motions in the best particle's map."""
        best = self.best
        candidates = compose(self.poses[best], motion + OFFSETS)
        found = self._likelihoods(slice(best, best + 1), scan.coarse, candidates[None], COARSE_SHARP)[0]
        share = TEMPER * len(scan.beams) / len(scan.coarse)
        return np.asarray(OFFSETS[int((found * share + _doubtful(OFFSETS, std)).argmax())])

    def _resample(self) -> None:
        chosen = systematic_sample(self.weights, float(self._rng.random()))
        self.store.choose(chosen)
        self.poses = self.poses[chosen]
        self.ancestry.choose(chosen)
        self._log_weights = np.zeros(len(self.poses))
        self.weights = np.full(len(self.poses), 1 / len(self.poses))
