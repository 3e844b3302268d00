"""Drives a differential-drive robot along waypoints: turn on the spot, then drive straight, smoothly.

The speed follows the remaining distance, ``v = sqrt(2 a d)``: the robot brakes with its own deceleration,
stops at the waypoint, and can always stop in front of an obstacle ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, inf, isfinite, sqrt
from typing import TYPE_CHECKING

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Speeds and accelerations of a robot: metres, radians, seconds.

    Attributes:
        speed: Highest forward speed.
        acceleration: Highest change of the forward speed.
        turn_rate: Highest rate of turn.
        turn_acceleration: Highest change of the rate of turn.
        reach: A waypoint this near is reached.
        facing: Turn on the spot if the waypoint is farther off the heading than this.
        gap: Minimum distance from the hull to an obstacle ahead.
    """

    speed: float = 0.8
    acceleration: float = 1.0
    turn_rate: float = 2.0
    turn_acceleration: float = 6.0
    reach: float = 0.04
    facing: float = 0.35
    gap: float = 0.08


def read_speed_limit(value: float) -> float:
    """Return the limit that a message on the topic ``speed_limit`` sets, metres per second.

    Args:
        value: Greatest speed, metres per second; 0: not limited.

    Raises:
        ValueError: It is negative, or not a finite number.
    """
    if not isfinite(value) or value < 0:
        raise ValueError(
            f"speed_limit: expected a speed in m/s, or 0 for no limit, found {value}; the limit before counts"
        )
    return value or inf


class Navigator:
    """Follows a list of waypoints.

    Args:
        limits: Speeds and accelerations of the robot.

    Attributes:
        speed_limit: Highest forward speed at present, metres per second, if it is below the robot's own.
    """

    def __init__(self, limits: DriveLimits | None = None) -> None:
        self.limits = limits or DriveLimits()
        self.speed_limit = inf
        self._waypoints: list[tuple[float, float]] = []
        self._twist = Twist()
        self._turning = False

    @property
    def waypoints(self) -> Sequence[tuple[float, float]]:
        """The remaining waypoints, metres."""
        return self._waypoints

    @property
    def standing(self) -> bool:
        """Whether the last step's speeds were zero."""
        return self._twist == Twist()

    @property
    def done(self) -> bool:
        """Whether the robot stands still at its last waypoint."""
        return not self._waypoints and self.standing

    def follow(self, waypoints: Sequence[tuple[float, float]]) -> None:
        """Replace the waypoints, without stopping first."""
        self._waypoints = list(waypoints)

    def stop(self) -> None:
        """Brake, and drop the remaining waypoints."""
        self._waypoints = []

    def update(self, pose: Pose, dt: float, clear: float = inf) -> Twist:
        """Return the speeds for the next ``dt`` seconds.

        Args:
            pose: Pose of the robot.
            dt: Time since the last step.
            clear: Free distance ahead of the hull, metres.
        """
        self._drop_reached(pose)
        wanted = self._wanted(pose, clear)
        self._twist = Twist(
            _towards(self._twist.speed, wanted.speed, self.limits.acceleration * dt),
            _towards(self._twist.turn_rate, wanted.turn_rate, self.limits.turn_acceleration * dt),
        )
        return self._twist

    def _drop_reached(self, pose: Pose) -> None:
        while self._waypoints:
            x, y = self._waypoints[0]
            away = hypot(x - pose.x, y - pose.y)
            bearing = wrap(atan2(y - pose.y, x - pose.x) - pose.yaw)
            # The waypoint is close and beside the robot: it cannot get nearer without turning back.
            passed = away < 3 * self.limits.reach and cos(bearing) <= 0
            if away > self.limits.reach and not passed:
                return
            del self._waypoints[0]

    def _wanted(self, pose: Pose, clear: float) -> Twist:
        if not self._waypoints:
            return Twist()
        limits = self.limits
        x, y = self._waypoints[0]
        away = hypot(x - pose.x, y - pose.y)
        error = wrap(atan2(y - pose.y, x - pose.x) - pose.yaw)
        self._turning = abs(error) > (limits.facing / 4 if self._turning else limits.facing)
        turn = max(-limits.turn_rate, min(limits.turn_rate, _braking(abs(error), limits)))
        if self._turning:
            return Twist(0.0, turn if error > 0 else -turn)
        room = max(0.0, clear - limits.gap)
        speed = min(
            limits.speed,
            self.speed_limit,
            sqrt(2 * limits.acceleration * max(away - limits.reach / 2, 0.0)),
            sqrt(2 * limits.acceleration * room),
        )
        # Close to a waypoint, small errors of the pose are large errors of the bearing: drive straight there.
        gain = min(1.0, away / (6 * limits.reach))
        return Twist(speed * max(cos(error), 0.0), gain * max(-turn, min(turn, 3.0 * error)))


def _braking(angle: float, limits: DriveLimits) -> float:
    """Return the turn rate from which a robot stops within ``angle``, with half of its deceleration."""
    return sqrt(limits.turn_acceleration * angle)


def _towards(value: float, wanted: float, step: float) -> float:
    return value + max(-step, min(step, wanted - value))
