"""The filter: Monte Carlo localization with an adaptive number of particles.

Thrun, Burgard, Fox: Probabilistic Robotics, section 8.3 (augmented MCL and KLD sampling), with the behaviour
and the parameters of ROS's ``amcl``. The caller gives odometry and scans; the filter gives the pose of the
robot on the map, and where the odometry's frame is on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.angles import wrap, wrap_array
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.beam_model import BeamModel
from rce_fleet.localization.clusters import Hypothesis, find_hypotheses
from rce_fleet.localization.contradiction import contradicts_map
from rce_fleet.localization.likelihood import LikelihoodField
from rce_fleet.localization.motion import move_particles
from rce_fleet.localization.parameters import AmclParameters, LaserModel
from rce_fleet.localization.resampling import effective_count, resample, systematic, temper
from rce_fleet.localization.scan import Beams, LaserScan, select_beams

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap

CONVERGED_M = 0.5
"""Beams are skipped only while all particles are this near to their middle, in x and in y."""


APART = 0.6
"""Least effective share of the particles after a scan, while they are apart. Then they are far from dense,
and the best of them may be a wrong one."""
TOGETHER = 0.02
"""The same while all particles are within ``CONVERGED_M``."""
CAUTION = 1.05
"""Random particles are drawn if scans fit worse than they used to by more than this factor: nu of Gutmann
and Fox, "An experimental comparison of localization methods continued", IROS 2002."""
FRESH_M, FRESH_RAD = 0.2, 0.5
"""A scan that was taken nearer to the one before repeats its errors: those of the map, and of things that are
not on it. Its likelihood is taken to the power of the share of this way or turn."""
LEAST_FRESH = 0.25
TRIED = 10
"""Where the robot may be anywhere, so many times as many places are tried with a scan as are kept."""
_JUDGES = 64


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an update found.

    Attributes:
        pose: The robot's most probable pose on the map.
        covariance: shape (3, 3): x, y (metres), yaw (radians).
        map_from_odom: Pose of the odometry's frame on the map.
        hypotheses: All places where the robot may be, the most probable first.
        resampled: Whether particles were chosen anew.
        agreement: How well the scan fits, averaged over the particles: 0 (not at all) .. 1 (each beam ends at
            an obstacle of the map).
    """

    pose: Pose
    covariance: NDArray[np.float64]
    map_from_odom: Pose
    hypotheses: list[Hypothesis]
    resampled: bool
    agreement: float


class Amcl:
    """The filter on one map. It begins at the parameters' initial pose.

    Args:
        grid: The map.
        parameters: Those of the filter.
        rng: Draws everything; the same state gives the same run.

    Raises:
        MapError: The map has no free cell.
    """

    def __init__(self, grid: OccupancyMap, parameters: AmclParameters, rng: np.random.Generator) -> None:
        self.parameters = parameters
        self._rng = rng
        self._fresh = 1.0
        self._odometry: Pose | None = None
        self.set_map(grid)
        start = Pose(parameters.initial_pose_x, parameters.initial_pose_y, parameters.initial_pose_a)
        spread = (parameters.initial_cov_xx, parameters.initial_cov_yy, parameters.initial_cov_aa)
        self.set_pose(start, np.diag(spread))

    @property
    def particles(self) -> NDArray[np.float64]:
        """The particles, shape (N, 3): x, y, yaw on the map."""
        return self._particles.T

    @property
    def weights(self) -> NDArray[np.float64]:
        """The particles' weights, shape (N,), with the sum 1."""
        return self._weights

    @property
    def grid(self) -> OccupancyMap:
        """The map."""
        return self._grid

    # From outside

    def set_map(self, grid: OccupancyMap) -> None:
        """Use another map; the particles stay where they are.

        Raises:
            MapError: The map has no free cell; the filter keeps the one it has.
        """
        if not grid.free_count:
            raise MapError("the map has no free cell, so the robot cannot be anywhere on it")
        self._grid = grid
        uses_beams = self.parameters.laser_model_type is LaserModel.BEAM
        self._beams = BeamModel(grid, self.parameters) if uses_beams else None
        self._field = None if uses_beams else LikelihoodField(grid, self.parameters)

    def set_pose(self, pose: Pose, covariance: ArrayLike, odometry: Pose | None = None) -> None:
        """Draw the particles around a pose.

        Args:
            pose: Where the robot probably is on the map.
            covariance: shape (3, 3), of x, y (metres) and yaw (radians); must be symmetric.
            odometry: Pose by odometry at the same time; None: it is that of the next scan.
        """
        values, axes = np.linalg.eigh(np.asarray(covariance, np.float64))
        normals = self._rng.standard_normal((3, self.parameters.max_particles))
        drawn = axes @ (np.sqrt(np.maximum(values, 0.0))[:, None] * normals) + pose.as_array()[:, None]
        self._start_with(drawn)
        self._odometry = odometry

    def scatter(self) -> None:
        """Draw the particles evenly over all free cells: the robot may be anywhere."""
        self._start_with(self._anywhere(self.parameters.max_particles))
        self._scattered = True

    def request_update(self) -> None:
        """Let the next scan update the filter, even if the robot stands."""
        self._forced = True

    def forget_odometry(self) -> None:
        """Keep the particles where they are at the next update: the odometry has jumped or begun anew."""
        self._odometry = None

    def _start_with(self, particles: NDArray[np.float64]) -> None:
        self._particles = particles
        self._particles[2] = wrap_array(particles[2])
        self._weights = np.full(particles.shape[1], 1.0 / particles.shape[1])
        self._odometry = None
        self._forced = True
        self._scattered = False
        self._updates = 0
        self._slow = self._fast = 0.0

    # Updates

    def needs_update(self, odometry: Pose) -> bool:
        """Return whether :meth:`update` would use a scan taken at this pose of the odometry."""
        if self._odometry is None or self._forced:
            return True
        before, parameters = self._odometry, self.parameters
        return (
            hypot(odometry.x - before.x, odometry.y - before.y) >= parameters.update_min_d
            or abs(wrap(odometry.yaw - before.yaw)) >= parameters.update_min_a
        )

    def update(self, odometry: Pose, scan: LaserScan) -> Estimate | None:
        """Update the filter with a scan, if the robot has moved enough.

        Args:
            odometry: Pose by odometry at the time of the scan.
            scan: The scan.

        Returns:
            What was found; None if the robot has not moved enough.
        """
        if not self.needs_update(odometry):
            return None
        self._fresh = 1.0
        if self._odometry is not None:
            self._fresh = _fresh_share(self._odometry, odometry)
            self._particles = move_particles(
                self._particles, self._odometry, odometry, self.parameters, self._rng
            )
        self._odometry = odometry
        self._forced = False
        beams = select_beams(scan, self.parameters)
        if self._scattered and beams.returned.any():
            self._scattered, self._fresh = False, 0.0  # The scan is used here, and does not count again.
            self._particles = self._search(self.parameters.max_particles, beams)
        agreement = self._weigh(beams)
        self._updates += 1
        hypotheses = find_hypotheses(self._particles, self._weights)
        best = hypotheses[0]
        resampled = self._updates % self.parameters.resample_interval == 0 and self._resample(
            beams, best.pose
        )
        map_from_odom = best.pose.compose(odometry.inverse())
        return Estimate(best.pose, best.covariance, map_from_odom, hypotheses, resampled, agreement)

    def _search(self, count: int, beams: Beams) -> NDArray[np.float64]:
        """Draw particles over all free cells, most of them where a scan fits; shape (3, ``count``).

        A few thousand particles are too far apart for one of them to be near enough to the right place.
        """
        field = self._field
        if field is None or not beams.returned.any():  # The beam model is too slow to try so many places.
            return self._anywhere(count)
        tried = [self._anywhere(count) for _ in range(TRIED)]
        logs = np.concatenate([self._logs(field, one, beams) for one in tried])
        weights = temper(np.full(len(logs), 1.0 / len(logs)), logs, 1 / TRIED)
        places = np.concatenate(tried, axis=1)
        return np.ascontiguousarray(places[:, systematic(weights, count, self._rng)])

    def _logs(
        self, field: LikelihoodField, particles: NDArray[np.float64], beams: Beams
    ) -> NDArray[np.float64]:
        """Return the logarithms of the likelihoods of a scan, shape (N,)."""
        if self.parameters.laser_model_type is LaserModel.LIKELIHOOD_FIELD:
            return np.asarray(np.log(field.sums_of_cubes(particles, beams)))
        skip = self.parameters.do_beamskip and self._has_converged()
        return beams.independence * field.log_products(particles, beams, skip=skip)

    def _weigh(self, beams: Beams) -> float:
        """Multiply the weights with those of a scan; return how well it fits."""
        parameters, particles = self.parameters, self._particles
        if self._field is None:
            assert self._beams is not None
            count = len(beams.ranges)
            if not count:
                return 0.0
            factors = self._beams.sums_of_cubes(particles, beams)
            return self._fit(self._apply(np.log(factors)), factors, count, beams)
        count = int(beams.returned.sum())
        if not count:
            return 0.0
        if parameters.laser_model_type is LaserModel.LIKELIHOOD_FIELD:
            factors = self._field.sums_of_cubes(particles, beams)
            return self._fit(self._apply(np.log(factors)), factors, count, beams)
        self._apply(self._logs(self._field, particles, beams))
        judges = systematic(self._weights, min(_JUDGES, len(self._weights)), self._rng)
        shares = np.full(len(judges), 1.0 / len(judges))
        return self._fit(shares, self._field.sums_of_cubes(particles[:, judges], beams), count, beams)

    def _apply(self, logs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply the weights by the exponentials of ``logs``, tempered; return the new weights."""
        self._weights = temper(
            self._weights, self._fresh * logs, TOGETHER if self._has_converged() else APART
        )
        return self._weights

    def _fit(
        self, weights: NDArray[np.float64], cubes: NDArray[np.float64], count: int, beams: Beams
    ) -> float:
        """Return how well a scan fits, and keep the averages that tell when the robot was moved by hand."""
        parameters = self.parameters
        best = parameters.laser_z_hit + parameters.laser_z_rand / beams.range_max
        average = float(weights @ np.cbrt((cubes - 1.0) / count)) / best
        # The slow average rises as fast as the other one: a bad beginning is not a standard for later.
        rate = parameters.recovery_alpha_slow if average < self._slow else parameters.recovery_alpha_fast
        self._slow += (average - self._slow) * (rate if self._slow else 1.0)
        self._fast += (average - self._fast) * (parameters.recovery_alpha_fast if self._fast else 1.0)
        return min(average, 1.0)

    def _has_converged(self) -> bool:
        places = self._particles[:2]
        return bool((places.max(axis=1) - places.min(axis=1) <= 2 * CONVERGED_M).all())

    # Resampling

    def _resample(self, beams: Beams, best: Pose) -> bool:
        count = len(self._weights)
        parameters = self.parameters
        if parameters.selective_resampling and effective_count(self._weights) > count / 2:
            return False
        chosen = self._particles[:, resample(self._particles, self._weights, parameters, self._rng)]
        anywhere = self._share_anywhere(beams, best)
        extra = self._rng.binomial(parameters.max_particles, anywhere) if anywhere > 0 else 0
        if extra:
            kept = self._rng.permutation(chosen.shape[1])[: parameters.max_particles - extra]
            chosen = np.concatenate((chosen[:, kept], self._search(extra, beams)), axis=1)
        self._particles = chosen
        self._particles[2] = wrap_array(chosen[2])
        self._weights = np.full(chosen.shape[1], 1.0 / chosen.shape[1])
        return True

    def _share_anywhere(self, beams: Beams, best: Pose) -> float:
        """Return the share of particles to draw anywhere, because scans fit worse than they used to.

        It is 0 where people or other robots around the robot explain that: the map is not contradicted.
        """
        if self.parameters.recovery_alpha_fast <= 0 or self._slow <= 0:
            return 0.0
        share = max(0.0, 1.0 - CAUTION * self._fast / self._slow)
        return share if share and contradicts_map(self._grid, best, beams) else 0.0

    def _anywhere(self, count: int) -> NDArray[np.float64]:
        cells = self._grid.free_cells(self._rng.integers(self._grid.free_count, size=count))
        inside = cells + self._rng.random((count, 2)) - 0.5
        drawn = np.empty((3, count))
        drawn[:2] = self._grid.cell_to_world(inside).T
        drawn[2] = self._rng.uniform(-np.pi, np.pi, count)
        return drawn


def _fresh_share(before: Pose, after: Pose) -> float:
    """Return how much of a scan is new after a motion, 0 .. 1."""
    way = hypot(after.x - before.x, after.y - before.y)
    turn = abs(wrap(after.yaw - before.yaw))
    return min(max(way / FRESH_M, turn / FRESH_RAD, LEAST_FRESH), 1.0)
