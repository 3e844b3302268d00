"""A simulated differential-drive robot."""

from __future__ import annotations

from math import cos, hypot, sin

import numpy as np
import pymunk

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.simulation.battery import Battery
from rce_fleet.simulation.contacts import Kind
from rce_fleet.simulation.drive import Drive
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.noise import PoseEstimate
from rce_fleet.simulation.odometry import Odometry


class SimulatedRobot:
    """A disc that drives forward and turns. Created by :meth:`rce_fleet.simulation.world.World.place_robot`.

    Its noise depends on the world's seed and its own id only, not on other robots or on who reads a sensor.

    Attributes:
        id: Name of the robot.
        model: What kind of robot it is.
        start: The pose at which it was placed.
        distance: Distance driven so far, metres.
        body: Its body in the physics engine.
        shape: Its hull in the physics engine.
        wheels: Its drive.
        battery: Its battery.
        pushed: Velocity over the ground that its wheels last made, ``(x, y)`` in metres per second.
    """

    def __init__(self, robot: str, pose: Pose, model: RobotModel, seed: int) -> None:
        self.id = robot
        self.model = model
        self.start = pose
        self._seed = [seed, *robot.encode()]
        self._scan_key = np.random.SeedSequence([0, *self._seed]).generate_state(2, np.uint64)
        self.reset()

    def reset(self) -> None:
        """Stand at the start as at the beginning, with a new body and the same noise to come."""
        model = self.model
        self.body = pymunk.Body(model.mass, pymunk.moment_for_circle(model.mass, 0.0, model.radius))
        self.shape = pymunk.Circle(self.body, model.radius)
        self.shape.collision_type = Kind.ROBOT
        drive, odometry, estimate = (np.random.default_rng([part, *self._seed]) for part in (1, 2, 3))
        self.distance = 0.0
        self.wheels = Drive(model.drive, drive)
        self.battery = Battery(model.battery)
        self._odometry = Odometry(model.odometry, odometry)
        self._estimate = PoseEstimate(model.estimate, estimate)
        self.put(self.start)

    def put(self, pose: Pose) -> None:
        """Stand still at a pose; odometry does not notice."""
        self.body.position = (pose.x, pose.y)
        self.body.angle = pose.yaw
        self.body.velocity, self.body.angular_velocity = (0.0, 0.0), 0.0
        self.wheels.stop()
        self.pushed = (0.0, 0.0)
        self._before = (pose.x, pose.y, pose.yaw)

    # Senses

    @property
    def radius(self) -> float:
        """Radius of the hull, metres."""
        return self.model.radius

    @property
    def pose(self) -> Pose:
        """The true pose."""
        x, y = self.body.position
        return Pose(x, y, wrap(self.body.angle))

    @property
    def place(self) -> tuple[float, float, float]:
        """The true pose after the last step as plain numbers; yaw is not wrapped."""
        return self._before

    @property
    def estimate(self) -> Pose:
        """The pose that stands for localization."""
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

    def scan_rng(self, step: int) -> np.random.Generator:
        """Return the source of the noise of a scan that is made after so many steps of the world."""
        return np.random.Generator(np.random.Philox(key=self._scan_key, counter=[0, 0, 0, step]))

    # Motion

    def drive(self, twist: Twist) -> None:
        """Set the wanted speeds."""
        self.wheels.command(twist)

    def push(self, dt: float, *, touched: bool = False) -> None:
        """Apply the wheels' motion to the body, before a step of ``dt`` seconds.

        The physics engine moves bodies first and then takes out of their velocities what leads into others. A
        velocity that is set before each step would thus press a touched robot into the other thing. A force
        acts between the two, so that the engine can take it out.
        """
        self.wheels.step(dt, powered=not self.battery.empty)
        ground, yaw, body = self.wheels.ground, self._before[2], self.body
        self.pushed = (ground.speed * cos(yaw), ground.speed * sin(yaw))
        if touched:
            vx, vy = body.velocity
            body.force = (body.mass * (self.pushed[0] - vx) / dt, body.mass * (self.pushed[1] - vy) / dt)
            body.torque = body.moment * (ground.turn_rate - body.angular_velocity) / dt
        else:
            body.velocity, body.angular_velocity = self.pushed, ground.turn_rate

    def settle(self, dt: float, *, docked: bool = False) -> None:
        """Update distance, odometry, battery and estimate after a step of ``dt`` seconds."""
        old_x, old_y, old_yaw = self._before
        (x, y), yaw = self.body.position, self.body.angle
        self._before = (x, y, yaw)
        self.distance += hypot(x - old_x, y - old_y)
        wheels = self.wheels.wheels
        if self.model.drive.wheels_stall:
            # What the wheels did is what the robot did, and what they slipped.
            grip = max(1.0 - self.wheels.slip, 0.1)
            way = (x - old_x) * cos(old_yaw) + (y - old_y) * sin(old_yaw)
            self._odometry.update(way / grip, (yaw - old_yaw) / grip)
        else:
            self._odometry.update(wheels.speed * dt, wheels.turn_rate * dt)
        self.battery.step(dt, wheels.speed, wheels.turn_rate, docked=docked)
        self._estimate.update(dt)
