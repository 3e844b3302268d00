"""Dead reckoning from wheels: biased, and noisy by the ``alpha`` model of ROS's ``amcl``.

The model (Thrun, Burgard, Fox: Probabilistic Robotics, section 5.4) gives variances for one update of the
filter: ``alpha1 rot^2 + alpha2 trans^2`` for each of the two turns of a motion, and ``alpha3 trans^2 +
alpha4 (rot1^2 + rot2^2)`` for its length. Odometry comes in much smaller steps, whose variances add up. A
step of length ``d`` therefore gets the share ``d / STRIDE`` of the variance of one update of the length
``STRIDE``, and a step that turns by ``a`` the share ``a / STRIDE_TURN``: after one update the variances are
those of the model, and they grow linearly with the way, whatever the time step is.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, inf, pi, sin, sqrt
from typing import TYPE_CHECKING, ClassVar

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.drive import Normals

if TYPE_CHECKING:
    import numpy as np

STRIDE = 0.2
"""Metres driven between two updates of ``amcl`` (its default ``update_min_d``)."""
STRIDE_TURN = pi / 6
"""Radians turned between two updates of ``amcl`` (its default ``update_min_a``)."""


@dataclass(frozen=True, slots=True)
class OdometrySpec:
    """Errors of a robot's odometry.

    Attributes:
        alpha1: Variance of a turn by its square, for an update of amcl.
        alpha2: Variance of a turn by the squared way, radians squared per metre squared.
        alpha3: Variance of the way by its square.
        alpha4: Variance of the way by the squared turn, metres squared per radian squared.
        distance_bias: Standard deviation of the scale of ways; one value is drawn for each robot.
        turn_bias: Standard deviation of the scale of turns, drawn likewise.
        drift: Standard deviation of a constant turn on straight ways, radians per metre, drawn likewise.
        rate: Messages in a second.
    """

    alpha1: float = 0.0008
    alpha2: float = 0.0
    alpha3: float = 0.002
    alpha4: float = 0.0
    distance_bias: float = 0.0
    turn_bias: float = 0.0
    drift: float = 0.0
    rate: float = 10.0

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        alphas = (self.alpha1, self.alpha2, self.alpha3, self.alpha4)
        if not all(0 <= alpha < inf for alpha in alphas):
            raise ValueError("alpha1 to alpha4 must be finite and not negative")
        if not all(0 <= bias < inf for bias in (self.distance_bias, self.turn_bias, self.drift)):
            raise ValueError("biases and drift must be finite and not negative")
        if not self.rate > 0:
            raise ValueError(f"rate must be positive, not {self.rate}")


class Odometry:
    """The odometry of one robot. Starts at the origin, heading along x.

    Args:
        spec: Its errors.
        rng: Draws them.

    Attributes:
        pose: The pose by odometry.
    """

    def __init__(self, spec: OdometrySpec, rng: np.random.Generator) -> None:
        self.pose = Pose(0.0, 0.0, 0.0)
        biases = rng.standard_normal(3)
        self._way_scale = 1.0 + spec.distance_bias * float(biases[0])
        self._turn_scale = 1.0 + spec.turn_bias * float(biases[1])
        self._drift = spec.drift * float(biases[2])
        self._turn_by_turn = spec.alpha1 * STRIDE_TURN
        self._turn_by_way = 2 * spec.alpha2 * STRIDE
        self._way_by_way = spec.alpha3 * STRIDE
        self._way_by_turn = spec.alpha4 * STRIDE_TURN
        self._normals = Normals(rng)

    def update(self, way: float, turn: float) -> None:
        """Add a motion of the wheels: metres forward, radians to the left."""
        far, wide = abs(way), abs(turn)
        if not far and not wide:
            return
        normals = self._normals
        measured_turn = turn * self._turn_scale + self._drift * way
        measured_turn += normals.next() * sqrt(self._turn_by_turn * wide + self._turn_by_way * far)
        measured_way = way * self._way_scale
        measured_way += normals.next() * sqrt(self._way_by_way * far + self._way_by_turn * wide)
        yaw = self.pose.yaw + measured_turn / 2
        self.pose = Pose(
            self.pose.x + measured_way * cos(yaw),
            self.pose.y + measured_way * sin(yaw),
            wrap(self.pose.yaw + measured_turn),
        )
