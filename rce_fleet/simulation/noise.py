"""The pose that stands for localization: truth with a small error. Seeded, so that a run can be repeated."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, sqrt
from typing import TYPE_CHECKING, ClassVar

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.drive import Normals

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, slots=True)
class EstimateSpec:
    """Errors of a pose that stands for localization.

    Attributes:
        position: Standard deviation of x and of y, metres.
        heading: Standard deviation of yaw, radians.
        memory: Correlation time of the error, seconds; like a filter's, it changes smoothly.
    """

    position: float = 0.01
    heading: float = 0.01
    memory: float = 1.0

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        if not (0 <= self.position < inf and 0 <= self.heading < inf and self.memory > 0):
            raise ValueError(
                "position and heading must be finite and not negative, and memory must be positive"
            )


class PoseEstimate:
    """The true pose with a small, slowly changing error.

    Args:
        spec: The error.
        rng: Draws it.
    """

    def __init__(self, spec: EstimateSpec, rng: np.random.Generator) -> None:
        self._spec = spec
        self._normals = Normals(rng)
        self._sigmas = (spec.position, spec.position, spec.heading)
        self._error = [sigma * self._normals.next() for sigma in self._sigmas]
        self._step = (0.0, 1.0, 0.0)

    @property
    def covariance(self) -> tuple[float, float, float]:
        """Variances of x, y (square metres) and yaw (square radians)."""
        x, y, yaw = (sigma * sigma for sigma in self._sigmas)
        return x, y, yaw

    def update(self, dt: float) -> None:
        """Advance the error by ``dt`` seconds: an Ornstein-Uhlenbeck process."""
        if self._step[0] != dt:
            keep = exp(-dt / self._spec.memory)
            self._step = (dt, keep, sqrt(1 - keep * keep))
        _, keep, fresh = self._step
        normals = self._normals
        self._error = [
            keep * error + fresh * sigma * normals.next()
            for error, sigma in zip(self._error, self._sigmas, strict=True)
        ]

    def of(self, truth: Pose) -> Pose:
        """Return the estimate of a true pose."""
        x, y, yaw = self._error
        return Pose(truth.x + x, truth.y + y, wrap(truth.yaw + yaw))
