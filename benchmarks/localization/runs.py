"""One seeded run of the filter with a robot that drives about."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import degrees, hypot, pi, radians
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.floor import TICK, Floor, shipped
from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.amcl import Amcl
from rce_fleet.localization.parameters import AmclParameters
from rce_fleet.navigation.navigation import DriveLimits, Navigator
from rce_fleet.nodes.amcl_parameters import AmclNodeParameters
from rce_fleet.nodes.parameter_values import read_values

if TYPE_CHECKING:
    from collections.abc import Callable

SHIPPED, _ = read_values(AmclNodeParameters, shipped("amcl.yaml"))
"""Those of ``configs/turtlebot``, for a lidar."""
CAMERA = replace(SHIPPED, recovery_alpha_slow=0.0, recovery_alpha_fast=0.0)
"""For a depth camera: a thing on no map that fills its view must not look like another place."""
STEP_S = 0.1
"""Time between two scans, seconds."""
_TICKS = round(STEP_S / TICK)
RIGHT_M, RIGHT_RAD = 0.3, radians(15)
"""A pose with smaller errors is right."""
FIRST_SPREAD = np.diag((0.05**2, 0.05**2, radians(5) ** 2))
"""Covariance of the first pose in runs that begin with one; it is drawn from this distribution."""


class Trip:
    """A robot that drives between random places on the floor, steered by its true pose.

    Args:
        seed: Of the floor and of the ways.
        sensor: The robot's.
    """

    def __init__(self, seed: int, sensor: str) -> None:
        self.floor = Floor(seed, sensor=sensor)
        self._limits = DriveLimits(speed=0.5, acceleration=0.6, turn_rate=1.2, turn_acceleration=4.0)
        self._navigator = Navigator(self._limits)

    def step(self) -> None:
        """Drive until the next scan."""
        robot, navigator = self.floor.robot, self._navigator
        for _ in range(_TICKS):
            if navigator.done or not navigator.waypoints:
                navigator.follow([self._next_place()])
            robot.drive(navigator.update(robot.pose, TICK))
            self.floor.step()

    def kidnap(self) -> None:
        """Put the robot at a random place at least 2 m away; its wheels do not notice."""
        floor, before = self.floor, self.floor.robot.pose
        x, y = before.x, before.y
        while hypot(x - before.x, y - before.y) < 2.0:
            x, y = floor.free_place()
        floor.move_robot(Pose(x, y, float(floor.rng.uniform(-pi, pi))))
        self._navigator = Navigator(self._limits)

    def _next_place(self) -> tuple[float, float]:
        """Choose a place that a straight way leads to."""
        floor, here = self.floor, self.floor.robot.pose
        for _ in range(2000):
            place = floor.free_place()
            far = hypot(place[0] - here.x, place[1] - here.y) >= 0.5
            if far and floor.has_straight_way((here.x, here.y), place, floor.robot.radius + 0.03):
                return place
        raise RuntimeError(f"no way out of {here}")


@dataclass(slots=True)
class Run:
    """What a run found.

    Attributes:
        away: Error of the position at each step, metres.
        turned: Error of the heading at each step, radians.
        nees: Normalized estimation error squared of each update.
        particles: Number of particles of each update.
        contacts: How often the robot touched something.
    """

    away: list[float] = field(default_factory=list)
    turned: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    particles: list[int] = field(default_factory=list)
    contacts: int = 0

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
    parameters: AmclParameters = SHIPPED,
    sensor: str = "lidar",
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
    trip = Trip(seed, sensor)
    floor, robot = trip.floor, trip.floor.robot
    amcl = Amcl(floor.map, parameters, np.random.default_rng([seed, 1]))
    if knows_start:
        first = robot.pose.as_array() + floor.rng.multivariate_normal(np.zeros(3), FIRST_SPREAD)
        amcl.set_pose(Pose.from_array(first), FIRST_SPREAD)
    else:
        amcl.scatter()
    run = Run()
    map_from_odom: Pose | None = None
    for step in range(1, round(seconds / STEP_S) + 1):
        trip.step()
        if kidnapped_at is not None and step == round(kidnapped_at / STEP_S):
            trip.kidnap()
        truth, odometry = robot.pose, robot.odometry
        if amcl.needs_update(odometry):
            estimate = amcl.update(odometry, floor.scan())
            assert estimate is not None
            map_from_odom = estimate.map_from_odom
            pose = estimate.pose
            error = np.array((pose.x - truth.x, pose.y - truth.y, wrap(pose.yaw - truth.yaw)))
            run.nees.append(float(error @ np.linalg.pinv(estimate.covariance) @ error))
            run.particles.append(len(amcl.weights))
        assert map_from_odom is not None
        found = map_from_odom.compose(odometry)
        run.away.append(hypot(found.x - truth.x, found.y - truth.y))
        run.turned.append(min(abs(wrap(found.yaw - truth.yaw)), pi))
    run.contacts = floor.world.collisions.total
    return run


def track(sensor: str) -> Callable[[int], Run]:
    """Return how to run with a known start."""
    parameters = CAMERA if sensor == "camera" else SHIPPED
    return lambda seed: drive(seed, parameters, sensor)


def globally(seed: int) -> Run:
    """Run for 30 s from anywhere."""
    return drive(seed, seconds=30.0, knows_start=False)


KIDNAPPED_AT, KIDNAPPED_FOR = 20.0, 60.0


def kidnapped(seed: int) -> Run:
    """Run for 60 s after the robot was put somewhere else."""
    return drive(seed, seconds=KIDNAPPED_AT + KIDNAPPED_FOR, kidnapped_at=KIDNAPPED_AT)
