"""One seeded run of the filter with a robot that drives about."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import degrees, hypot, pi, radians
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.localization.world import DEPTH_CAMERA, LIDAR, STEP_S, Floor, Robot, Sensor
from rce_fleet.geometry.angles import wrap
from rce_fleet.localization.amcl import Amcl
from rce_fleet.localization.parameters import AmclParameters, LaserModel

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.geometry.poses import Pose

RECOVERING = AmclParameters(
    laser_model_type=LaserModel.LIKELIHOOD_FIELD_PROB,
    laser_max_beams=60,
    recovery_alpha_slow=0.001,
    recovery_alpha_fast=0.1,
)
"""For robots with a lidar, as the documentation recommends."""
CAMERA = AmclParameters(laser_max_beams=60)
RIGHT_M, RIGHT_RAD = 0.3, radians(15)
"""A pose with smaller errors is right."""
FIRST_SPREAD = np.diag((0.05**2, 0.05**2, radians(5) ** 2))
"""Covariance of the first pose in runs that begin with one; it is drawn from this distribution."""


@dataclass(slots=True)
class Run:
    """What a run found.

    Attributes:
        away: Error of the position at each step, metres.
        turned: Error of the heading at each step, radians.
        nees: Normalized estimation error squared of each update.
        particles: Number of particles of each update.
    """

    away: list[float] = field(default_factory=list)
    turned: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    particles: list[int] = field(default_factory=list)

    @property
    def rmse_m(self) -> float:
        """Root mean square error of the position, metres."""
        return float(np.sqrt(np.mean(np.square(self.away))))

    @property
    def rmse_deg(self) -> float:
        """Root mean square error of the heading, degrees."""
        return degrees(float(np.sqrt(np.mean(np.square(self.turned)))))

    @property
    def right_after(self) -> float:
        """Time from which on the pose is right to the end, seconds."""
        right = (np.array(self.away) < RIGHT_M) & (np.array(self.turned) < RIGHT_RAD)
        wrong = np.flatnonzero(~right)
        return float(wrong[-1] + 1) * STEP_S if len(wrong) else 0.0


def drive(
    seed: int,
    parameters: AmclParameters = RECOVERING,
    sensor: Sensor = LIDAR,
    *,
    seconds: float = 60.0,
    knows_start: bool = True,
    kidnapped_at: float | None = None,
) -> Run:
    """Localize a robot that drives about.

    Args:
        seed: Of floor, way, noise and filter.
        parameters: Those of the filter.
        sensor: The robot's.
        seconds: Length of the run.
        knows_start: Whether the filter gets a first pose, with an error; else it begins anywhere.
        kidnapped_at: When the robot is put somewhere else, seconds.
    """
    rng = np.random.default_rng(seed)
    floor = Floor(rng)
    robot = Robot(floor, rng)
    amcl = Amcl(floor.grid, parameters, np.random.default_rng([seed, 1]))
    if knows_start:
        first = robot.pose.as_array() + rng.multivariate_normal(np.zeros(3), FIRST_SPREAD)
        amcl.set_pose(type(robot.pose).from_array(first), FIRST_SPREAD)
    else:
        amcl.scatter()
    run = Run()
    map_from_odom: Pose | None = None
    while robot.time < seconds - STEP_S / 2:
        robot.step()
        if kidnapped_at is not None and abs(robot.time - kidnapped_at) < STEP_S / 2:
            robot.kidnap()
        truth = robot.pose
        if amcl.needs_update(robot.odometry):
            estimate = amcl.update(robot.odometry, floor.scan(truth, sensor, rng))
            assert estimate is not None
            map_from_odom = estimate.map_from_odom
            pose = estimate.pose
            error = np.array((pose.x - truth.x, pose.y - truth.y, wrap(pose.yaw - truth.yaw)))
            run.nees.append(float(error @ np.linalg.pinv(estimate.covariance) @ error))
            run.particles.append(len(amcl.weights))
        assert map_from_odom is not None
        found = map_from_odom.compose(robot.odometry)
        run.away.append(hypot(found.x - truth.x, found.y - truth.y))
        run.turned.append(min(abs(wrap(found.yaw - truth.yaw)), pi))
    return run


def track(sensor: Sensor) -> Callable[[int], Run]:
    """Return how to run with a known start."""
    parameters = CAMERA if sensor is DEPTH_CAMERA else RECOVERING
    return lambda seed: drive(seed, parameters, sensor)


def globally(seed: int) -> Run:
    """Run for 30 s from anywhere."""
    return drive(seed, seconds=30.0, knows_start=False)


KIDNAPPED_AT, KIDNAPPED_FOR = 20.0, 60.0


def kidnapped(seed: int) -> Run:
    """Run for 60 s after the robot was put somewhere else."""
    return drive(seed, seconds=KIDNAPPED_AT + KIDNAPPED_FOR, kidnapped_at=KIDNAPPED_AT)
