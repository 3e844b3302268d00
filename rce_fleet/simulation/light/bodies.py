"""The bodies of many differential-drive robots: acceleration limits, slip, error of the estimated pose.

The motion is that of :class:`rce_fleet.simulation.drive.Drive` and of a free body in the physics engine, for
all robots at once: in a step of ``dt`` the wheels' speeds change within their limits, the body moves along
the heading that it had, and then turns.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.simulation.drive import DriveSpec
from rce_fleet.simulation.lidar import Floats
from rce_fleet.simulation.light.batteries import TURTLEBOT_BATTERY
from rce_fleet.simulation.noise import EstimateSpec

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.geometry.poses import Pose
    from rce_fleet.simulation.battery import BatterySpec

TURTLEBOT = DriveSpec(
    speed=0.65,
    turn_rate=3.14,
    acceleration=1.0,
    deceleration=2.0,
    turn_acceleration=4.0,
    slip=0.005,
    slip_noise=0.01,
    slip_memory=0.5,
)
"""Wheels of a TurtleBot 2, without the timeout of its commands."""


@dataclass(frozen=True, slots=True)
class LightModel:
    """What all light robots of a world are like.

    Attributes:
        radius: Radius of the hull, metres.
        drive: The wheels.
        estimate: Error of the estimated pose: what odometry and its correction by localization leave.
        battery: The battery.
    """

    radius: float = 0.177
    drive: DriveSpec = TURTLEBOT
    estimate: EstimateSpec = field(default_factory=lambda: EstimateSpec(0.02, 0.01, 2.0))
    battery: BatterySpec = TURTLEBOT_BATTERY


class LightBodies:
    """Places and speeds of robots, one row for each.

    The noise of a robot depends on the seed and on the number of robots.

    Args:
        starts: Where the robots stand at first.
        model: What they are like.
        seed: Seed of the noise.

    Attributes:
        poses: True poses, shape (N, 3): x, y (metres), yaw (radians, not wrapped).
        speeds: Speeds of the wheels, shape (N, 2): metres and radians per second.
        distances: Way driven, shape (N,), metres.
    """

    def __init__(self, starts: Sequence[Pose], model: LightModel, seed: int = 0) -> None:
        self.model = model
        self._starts: Floats = np.array([(pose.x, pose.y, pose.yaw) for pose in starts], np.float64)
        self._starts = self._starts.reshape(-1, 3)
        self._seed = seed
        self.reset()

    def __len__(self) -> int:
        return len(self.poses)

    def reset(self) -> None:
        """Stand at the starts, with the same noise to come."""
        count, spec = len(self._starts), self.model.estimate
        self._rng = np.random.default_rng([self._seed, count])
        self._sigmas = np.array([spec.position, spec.position, spec.heading])
        self.poses = self._starts.copy()
        self.speeds = np.zeros((count, 2))
        self.distances = np.zeros(count)
        self._slip = np.full(count, self.model.drive.slip)
        self._errors = self._sigmas * self._rng.standard_normal((count, 3))

    @property
    def estimates(self) -> Floats:
        """Estimated poses, shape (N, 3)."""
        return self.poses + self._errors

    def put(self, robot: int, pose: Pose, *, as_start: bool = False) -> None:
        """Put a robot elsewhere, where it stands; ``as_start``: it also stands there after a reset."""
        self.poses[robot] = pose.x, pose.y, pose.yaw
        if as_start:
            self._starts[robot] = self.poses[robot]
        self.speeds[robot] = 0.0

    def step(self, commands: Floats, dt: float) -> None:
        """Advance by ``dt`` seconds.

        Args:
            commands: Wanted speeds, shape (N, 2): metres and radians per second.
            dt: Seconds.
        """
        drive, speed, turn = self.model.drive, self.speeds[:, 0], self.speeds[:, 1]
        wanted = np.clip(commands[:, 0], -drive.speed, drive.speed)
        wanted_turn = np.clip(commands[:, 1], -drive.turn_rate, drive.turn_rate)
        slows = (np.abs(wanted) < np.abs(speed)) | (wanted * speed < 0)
        limit = np.where(slows, drive.deceleration, drive.acceleration) * dt
        speed += np.clip(wanted - speed, -limit, limit)
        turn_limit = drive.turn_acceleration * dt
        turn += np.clip(wanted_turn - turn, -turn_limit, turn_limit)
        if drive.slip_noise:
            keep = exp(-dt / drive.slip_memory)
            spread = sqrt(1 - keep * keep) * drive.slip_noise
            self._slip = drive.slip + keep * (self._slip - drive.slip)
            self._slip += spread * self._rng.standard_normal(len(self))
            np.clip(self._slip, -0.5, 1.0, out=self._slip)
        grip = 1.0 - self._slip
        way = speed * grip * dt
        yaw = self.poses[:, 2]
        self.poses[:, 0] += way * np.cos(yaw)
        self.poses[:, 1] += way * np.sin(yaw)
        yaw += turn * grip * dt
        self.distances += np.abs(way)
        self._err(dt)

    def _err(self, dt: float) -> None:
        """Advance the errors of the estimates: Ornstein-Uhlenbeck processes."""
        keep = exp(-dt / self.model.estimate.memory)
        fresh = sqrt(1 - keep * keep) * self._sigmas
        self._errors *= keep
        self._errors += fresh * self._rng.standard_normal((len(self), 3))
