"""Noise of the simulated robots' sensors. All of it is seeded, so that a run can be repeated."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, exp, sin, sqrt

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose


@dataclass(frozen=True, slots=True)
class NoiseSpec:
    """Amount of a robot's sensor noise.

    Attributes:
        position: Standard deviation of the pose estimate, metres.
        heading: Standard deviation of the pose estimate, radians.
        memory: Correlation time of the estimate's error, seconds; like a filter's, it changes smoothly.
        distance: Standard deviation of odometry, metres for one metre driven.
        turn: Standard deviation of odometry, radians for one radian turned.
    """

    position: float = 0.01
    heading: float = 0.01
    memory: float = 1.0
    distance: float = 0.02
    turn: float = 0.02


class PoseEstimate:
    """The true pose with a small, slowly changing error; stands for localization."""

    def __init__(self, spec: NoiseSpec, rng: np.random.Generator) -> None:
        self._sigma = np.array((spec.position, spec.position, spec.heading))
        self._memory = spec.memory
        self._rng = rng
        self._error = self._sigma * rng.standard_normal(3)

    @property
    def covariance(self) -> tuple[float, float, float]:
        """Variances of x, y (square metres) and yaw (square radians)."""
        x, y, yaw = (float(value) for value in self._sigma**2)
        return x, y, yaw

    def update(self, dt: float) -> None:
        """Advance the error by ``dt`` seconds: an Ornstein-Uhlenbeck process."""
        keep = exp(-dt / self._memory)
        self._error = keep * self._error + sqrt(1 - keep * keep) * self._sigma * self._rng.standard_normal(3)

    def of(self, truth: Pose) -> Pose:
        """Return the estimate of a true pose."""
        x, y, yaw = (float(value) for value in self._error)
        return Pose(truth.x + x, truth.y + y, wrap(truth.yaw + yaw))


class Odometry:
    """Dead reckoning from wheels that slip slightly. Starts at the origin, heading along x."""

    def __init__(self, spec: NoiseSpec, rng: np.random.Generator) -> None:
        self._spec = spec
        self._rng = rng
        self.pose = Pose(0.0, 0.0, 0.0)

    def update(self, before: Pose, after: Pose) -> None:
        """Add the motion between two true poses."""
        forward = (after.x - before.x) * cos(before.yaw) + (after.y - before.y) * sin(before.yaw)
        turn = wrap(after.yaw - before.yaw)
        # Errors add up: their variance, not their standard deviation, grows with the distance.
        first, second = (float(value) for value in self._rng.standard_normal(2))
        forward += first * self._spec.distance * sqrt(abs(forward))
        turn += second * self._spec.turn * sqrt(abs(turn))
        yaw = self.pose.yaw + turn / 2
        self.pose = Pose(
            self.pose.x + forward * cos(yaw),
            self.pose.y + forward * sin(yaw),
            wrap(self.pose.yaw + turn),
        )
