"""Parameters of the localization, with the names and defaults of ROS 1's ``amcl``.

http://wiki.ros.org/amcl documents them. The metadata of a field holds the values allowed; the node reads it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from math import pi
from typing import Any


class OdometryModel(StrEnum):
    """How a robot moves, and how its odometry errs. The corrected ones take the alphas as variances."""

    DIFF = "diff"
    DIFF_CORRECTED = "diff-corrected"
    OMNI = "omni"
    OMNI_CORRECTED = "omni-corrected"


class LaserModel(StrEnum):
    """How probable a scan is at a pose."""

    LIKELIHOOD_FIELD = "likelihood_field"
    LIKELIHOOD_FIELD_PROB = "likelihood_field_prob"
    BEAM = "beam"


def _from(default: float, minimum: float = 0.0, maximum: float | None = None) -> Any:
    bounds = {"minimum": minimum} if maximum is None else {"minimum": minimum, "maximum": maximum}
    return field(default=default, metadata=bounds)


def _above(default: float, above: float = 0.0) -> Any:
    return field(default=default, metadata={"above": above})


def _count(default: int, minimum: int = 1) -> Any:
    return field(default=default, metadata={"minimum": minimum})


@dataclass(frozen=True, kw_only=True)
class AmclParameters:
    """Parameters of the filter. Metres, radians, seconds.

    Attributes:
        min_particles: Least number of particles.
        max_particles: Greatest number of particles.
        kld_err: Maximum error between the particles' distribution and the estimated one.
        kld_z: Upper standard normal quantile of the probability that the error is at most ``kld_err``: 0.99
            stands for 84 %, 2.33 for 99 %.
        update_min_d: The filter is updated after this way.
        update_min_a: The filter is updated after this turn.
        resample_interval: Number of updates between two resamplings.
        selective_resampling: Resample only if the effective number of particles is below half of all.
        recovery_alpha_slow: Rate of the slow average of the weights; 0 turns random particles off. 0.001 is
            a good value.
        recovery_alpha_fast: Rate of the fast average. 0.1 is a good value.
        initial_pose_x: Mean of the initial particles.
        initial_pose_y: Mean of the initial particles.
        initial_pose_a: Mean heading of the initial particles.
        initial_cov_xx: Variance of the initial particles, square metres.
        initial_cov_yy: Variance of the initial particles, square metres.
        initial_cov_aa: Variance of their heading, square radians.
        laser_min_range: Nearer ranges are not used; -1: the scan's own limit.
        laser_max_range: Farther ranges are not used; -1: the scan's own limit.
        laser_max_beams: Number of beams of a scan that are used, evenly spaced.
        laser_z_hit: Weight of beams that hit what the map shows.
        laser_z_short: Weight of beams that end early (beam model).
        laser_z_max: Weight of beams without return (beam model).
        laser_z_rand: Weight of random ranges.
        laser_sigma_hit: Standard deviation of ranges around what the map shows.
        laser_lambda_short: Decay of early ends, 1/m (beam model).
        laser_likelihood_max_dist: Distances to obstacles are cut at this one.
        laser_model_type: How probable a scan is at a pose.
        do_beamskip: Leave out beams that contradict the map at most particles (``likelihood_field_prob``).
        beam_skip_distance: A beam agrees with the map if it ends this near to an obstacle.
        beam_skip_threshold: A beam is used if this share of the particles agrees with it.
        beam_skip_error_threshold: If a greater share of the beams would be left out, all are used.
        odom_model_type: How the robot moves.
        odom_alpha1: Error of turns by turns.
        odom_alpha2: Error of turns by ways.
        odom_alpha3: Error of ways by ways.
        odom_alpha4: Error of ways by turns.
        odom_alpha5: Error across the direction of the way (omni).
    """

    min_particles: int = _count(100)
    max_particles: int = _count(5000)
    kld_err: float = _above(0.01)
    kld_z: float = _above(0.99)
    update_min_d: float = _from(0.2)
    update_min_a: float = _from(pi / 6)
    resample_interval: int = _count(2)
    selective_resampling: bool = False
    recovery_alpha_slow: float = _from(0.0, maximum=1.0)
    recovery_alpha_fast: float = _from(0.0, maximum=1.0)
    initial_pose_x: float = 0.0
    initial_pose_y: float = 0.0
    initial_pose_a: float = 0.0
    initial_cov_xx: float = _from(0.25)
    initial_cov_yy: float = _from(0.25)
    initial_cov_aa: float = _from((pi / 12) ** 2)
    laser_min_range: float = _from(-1.0, -1.0)
    laser_max_range: float = _from(-1.0, -1.0)
    laser_max_beams: int = _count(30, 2)
    laser_z_hit: float = _from(0.95)
    laser_z_short: float = _from(0.1)
    laser_z_max: float = _from(0.05)
    laser_z_rand: float = _from(0.05)
    laser_sigma_hit: float = _above(0.2)
    laser_lambda_short: float = _above(0.1)
    laser_likelihood_max_dist: float = _above(2.0)
    laser_model_type: LaserModel = LaserModel.LIKELIHOOD_FIELD
    do_beamskip: bool = False
    beam_skip_distance: float = _from(0.5)
    beam_skip_threshold: float = _from(0.3, maximum=1.0)
    beam_skip_error_threshold: float = _from(0.9, maximum=1.0)
    odom_model_type: OdometryModel = OdometryModel.DIFF
    odom_alpha1: float = _from(0.2)
    odom_alpha2: float = _from(0.2)
    odom_alpha3: float = _from(0.2)
    odom_alpha4: float = _from(0.2)
    odom_alpha5: float = _from(0.2)

    def __post_init__(self) -> None:
        if self.min_particles > self.max_particles:
            raise ValueError(
                f"min_particles is {self.min_particles}, must be at most max_particles, {self.max_particles}"
            )
