"""How a robot's odometry errs: moves particles by what the odometry says, with noise.

The differential model is ``sample_motion_model_odometry`` of Thrun, Burgard, Fox: Probabilistic Robotics,
section 5.4; the omnidirectional one is that of ROS's ``amcl``. The models ``diff`` and ``omni`` use the sums
of squares as standard deviations, as ROS's always did; the corrected ones use them as variances.
"""

from __future__ import annotations

from math import atan2, hypot, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel
from rce_fleet.geometry.angles import wrap
from rce_fleet.localization.parameters import AmclParameters, OdometryModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.geometry.poses import Pose

STANDING = 0.01
"""On shorter ways the direction of the way is rounding noise and not taken for a turn, metres."""


def move_particles(
    particles: NDArray[np.float64],
    before: Pose,
    after: Pose,
    parameters: AmclParameters,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Return particles moved as odometry says, each with its own error.

    Args:
        particles: shape (3, N): x, y, yaw.
        before: Odometry at the last update.
        after: Odometry now.
        parameters: ``odom_model_type`` and the alphas.
        rng: Draws the errors.

    Returns:
        shape (3, N). Yaws are not wrapped.
    """
    model = parameters.odom_model_type
    if model in (OdometryModel.DIFF, OdometryModel.DIFF_CORRECTED):
        return _move_differential(particles, before, after, parameters, rng)
    return _move_omni(particles, before, after, parameters, rng)


def _move_differential(
    particles: NDArray[np.float64],
    before: Pose,
    after: Pose,
    parameters: AmclParameters,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    dx, dy = after.x - before.x, after.y - before.y
    way = hypot(dx, dy)
    first = wrap(atan2(dy, dx) - before.yaw) if way >= STANDING else 0.0
    second = wrap(after.yaw - before.yaw - first)
    # Driving backwards is not a turn of 180 degrees: it errs as little as forwards.
    first2, second2 = (min(abs(turn), pi - abs(turn)) ** 2 for turn in (first, second))
    a1, a2 = parameters.odom_alpha1, parameters.odom_alpha2
    a3, a4 = parameters.odom_alpha3, parameters.odom_alpha4
    spread = (
        a1 * first2 + a2 * way * way,
        a3 * way * way + a4 * (first2 + second2),
        a1 * second2 + a2 * way * way,
    )
    sigma = _sigma(spread, corrected=parameters.odom_model_type is OdometryModel.DIFF_CORRECTED)
    noise = rng.standard_normal((3, particles.shape[1]))
    return turn_drive_turn(
        np.ascontiguousarray(particles), noise, sigma[:, 0], np.array((first, way, second))
    )


def _turn_drive_turn_numpy(
    particles: NDArray[np.float64],
    noise: NDArray[np.float64],
    sigma: NDArray[np.float64],
    motion: NDArray[np.float64],
) -> NDArray[np.float64]:
    drawn = noise * sigma[:, None] + motion[:, None]
    heading = particles[2] + drawn[0]
    moved = np.empty_like(particles)
    moved[0] = particles[0] + drawn[1] * np.cos(heading)
    moved[1] = particles[1] + drawn[1] * np.sin(heading)
    moved[2] = heading + drawn[2]
    return moved


@kernel(
    "float64[:,::1](float64[:,::1], float64[:,::1], float64[::1], float64[::1])",
    numpy=_turn_drive_turn_numpy,
)
def turn_drive_turn(
    particles: NDArray[np.float64],
    noise: NDArray[np.float64],
    sigma: NDArray[np.float64],
    motion: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return particles that turned, drove and turned again.

    Args:
        particles: shape (3, N).
        noise: shape (3, N), of standard deviation 1.
        sigma: shape (3,): standard deviations of turn, way and turn.
        motion: shape (3,): turn, way and turn by odometry.

    Returns:
        shape (3, N).
    """
    moved = np.empty_like(particles)
    for i in range(particles.shape[1]):
        heading = particles[2, i] + (noise[0, i] * sigma[0] + motion[0])
        length = noise[1, i] * sigma[1] + motion[1]
        moved[0, i] = particles[0, i] + length * np.cos(heading)
        moved[1, i] = particles[1, i] + length * np.sin(heading)
        moved[2, i] = heading + (noise[2, i] * sigma[2] + motion[2])
    return moved


def _move_omni(
    particles: NDArray[np.float64],
    before: Pose,
    after: Pose,
    parameters: AmclParameters,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    dx, dy = after.x - before.x, after.y - before.y
    way = hypot(dx, dy)
    turn = wrap(after.yaw - before.yaw)
    way2, turn2 = way * way, turn * turn
    spread = (
        parameters.odom_alpha3 * way2 + parameters.odom_alpha1 * turn2,
        parameters.odom_alpha4 * turn2 + parameters.odom_alpha2 * way2,
        parameters.odom_alpha1 * turn2 + parameters.odom_alpha5 * way2,
    )
    sigma = _sigma(spread, corrected=parameters.odom_model_type is OdometryModel.OMNI_CORRECTED)
    noise = rng.standard_normal((3, particles.shape[1])) * sigma
    bearing = particles[2] + (wrap(atan2(dy, dx) - before.yaw) if way > 0 else 0.0)
    along, across = noise[0] + way, noise[2]
    c, s = np.cos(bearing), np.sin(bearing)
    return np.stack(
        (
            particles[0] + along * c + across * s,
            particles[1] + along * s - across * c,
            particles[2] + (noise[1] + turn),
        )
    )


def _sigma(spread: tuple[float, float, float], *, corrected: bool) -> NDArray[np.float64]:
    values = [sqrt(value) for value in spread] if corrected else list(spread)
    return np.array(values)[:, None]
