"""A simulated differential-drive robot."""

from __future__ import annotations

from math import cos, hypot, sin
from typing import TYPE_CHECKING

import pymunk

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.simulation.noise import NoiseSpec, Odometry, PoseEstimate

if TYPE_CHECKING:
    import numpy as np

_MASS = 20.0


class SimulatedRobot:
    """A disc that drives forward and turns. Created by :meth:`rce_fleet.simulation.world.World.add_robot`.

    Attributes:
        id: Name of the robot.
        radius: Radius of the hull, metres.
        distance: Distance driven so far, metres.
        rng: Source of its noise.
        body: Its body in the physics engine.
        shape: Its hull in the physics engine.
    """

    def __init__(
        self, robot: str, pose: Pose, radius: float, noise: NoiseSpec, rng: np.random.Generator
    ) -> None:
        self.id = robot
        self.radius = radius
        self.distance = 0.0
        self.rng = rng
        self.body = pymunk.Body(_MASS, pymunk.moment_for_circle(_MASS, 0.0, radius))
        self.body.position = (pose.x, pose.y)
        self.body.angle = pose.yaw
        self.shape = pymunk.Circle(self.body, radius)
        self._command = Twist()
        self._before = self.pose
        self._estimate = PoseEstimate(noise, rng)
        self._odometry = Odometry(noise, rng)

    # Senses

    @property
    def pose(self) -> Pose:
        """The true pose."""
        x, y = self.body.position
        return Pose(x, y, wrap(self.body.angle))

    @property
    def estimate(self) -> Pose:
        """The estimated pose."""
        return self._estimate.of(self.pose)

    @property
    def covariance(self) -> tuple[float, float, float]:
        """Variances of the estimate: x, y (square metres) and yaw (square radians)."""
        return self._estimate.covariance

    @property
    def odometry(self) -> Pose:
        """The pose by odometry, relative to the start."""
        return self._odometry.pose

    @property
    def twist(self) -> Twist:
        """The true velocity."""
        vx, vy = self.body.velocity
        yaw = self.body.angle
        return Twist(vx * cos(yaw) + vy * sin(yaw), self.body.angular_velocity)

    # Motion

    def drive(self, twist: Twist) -> None:
        """Set the speeds of the wheels."""
        self._command = twist

    def push(self) -> None:
        """Apply the wheels' speeds to the body, before a step of the world."""
        yaw = self.body.angle
        self.body.velocity = (self._command.speed * cos(yaw), self._command.speed * sin(yaw))
        self.body.angular_velocity = self._command.turn_rate
        self._before = self.pose

    def settle(self, dt: float) -> None:
        """Update distance, odometry and estimate after a step of ``dt`` seconds."""
        after = self.pose
        self.distance += hypot(after.x - self._before.x, after.y - self._before.y)
        self._odometry.update(self._before, after)
        self._estimate.update(dt)
