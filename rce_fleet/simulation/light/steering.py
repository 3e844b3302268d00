"""Steers many robots to goals: turn on the spot, then drive straight, smoothly.

The same rules as :class:`rce_fleet.navigation.navigation.Navigator`, for all robots at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.navigation.navigation import DriveLimits
from rce_fleet.simulation.lidar import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.simulation.light.bodies import LightModel


def limits_of(model: LightModel) -> DriveLimits:
    """Return limits within those of a model's wheels."""
    usual, wheels = DriveLimits(), model.drive
    return DriveLimits(
        speed=min(usual.speed, wheels.speed),
        acceleration=min(usual.acceleration, wheels.acceleration, wheels.deceleration),
        turn_rate=min(usual.turn_rate, wheels.turn_rate),
        turn_acceleration=min(usual.turn_acceleration, wheels.turn_acceleration),
    )


class Steering:
    """The controllers of robots, one row for each.

    Args:
        count: Number of robots.
        limits: Their speeds and accelerations.

    Attributes:
        goals: Where they drive to, shape (N, 2), metres.
        speed_limits: Highest forward speeds at present, shape (N,), metres per second; infinity: the robot's
            own.
        driving: Which of them have a goal that they have not reached, shape (N,).
        commands: Speeds to drive, shape (N, 2): metres and radians per second.
    """

    def __init__(self, count: int, limits: DriveLimits) -> None:
        self.limits = limits
        self.goals: Floats = np.zeros((count, 2))
        self.speed_limits: Floats = np.full(count, np.inf)
        self.driving: NDArray[np.bool_] = np.zeros(count, np.bool_)
        self.commands: Floats = np.zeros((count, 2))
        self._turning: NDArray[np.bool_] = np.zeros(count, np.bool_)

    @property
    def standing(self) -> NDArray[np.bool_]:
        """Which robots are told to stand, shape (N,)."""
        stands: NDArray[np.bool_] = (self.commands == 0.0).all(axis=1)
        return stands

    def follow(self, robot: int, x: float, y: float) -> None:
        """Give a robot a goal, in place of the one before."""
        self.goals[robot] = x, y
        self.driving[robot] = True

    def stop(self, robot: int) -> None:
        """Brake, and forget the goal."""
        self.driving[robot] = False

    def update(self, poses: Floats, dt: float) -> None:
        """Choose the commands for the next ``dt`` seconds.

        Args:
            poses: Estimated poses, shape (N, 3): metres, radians.
            dt: Time since the last update, seconds.
        """
        limits = self.limits
        offsets = self.goals - poses[:, :2]
        away = np.hypot(offsets[:, 0], offsets[:, 1])
        error = np.arctan2(offsets[:, 1], offsets[:, 0]) - poses[:, 2]
        error = np.arctan2(np.sin(error), np.cos(error))
        ahead = np.cos(error)
        self.driving &= (away > limits.reach) & ((away >= 3 * limits.reach) | (ahead > 0))
        facing = np.where(self._turning, limits.facing / 4, limits.facing)
        self._turning = np.where(self.driving, np.abs(error) > facing, self._turning)
        turn = np.minimum(limits.turn_rate, np.sqrt(limits.turn_acceleration * np.abs(error)))
        speed = np.minimum(
            np.minimum(limits.speed, self.speed_limits),
            np.sqrt(2 * limits.acceleration * np.maximum(away - limits.reach / 2, 0.0)),
        )
        gain = np.minimum(1.0, away / (6 * limits.reach))
        on_the_way = self.driving & ~self._turning
        wanted = np.where(on_the_way, speed * np.maximum(ahead, 0.0), 0.0)
        wanted_turn = np.where(
            self._turning, np.copysign(turn, error), gain * np.clip(3.0 * error, -turn, turn)
        )
        wanted_turn = np.where(self.driving, wanted_turn, 0.0)
        for column, target, limit in (
            (0, wanted, limits.acceleration * dt),
            (1, wanted_turn, limits.turn_acceleration * dt),
        ):
            self.commands[:, column] += np.clip(target - self.commands[:, column], -limit, limit)
