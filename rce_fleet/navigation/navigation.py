"""Drives a differential-drive robot along waypoints: turn on the spot, then straight on, smoothly.

The speed follows the distance left, ``v = sqrt(2 a d)``, so that a robot brakes with its own deceleration and
stands at the waypoint, and never goes faster than it could stop before an obstacle ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, inf, sqrt
from typing import TYPE_CHECKING

from rce_fleet.navigation.angles import wrap

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """What a robot can do: metres, radians, seconds.

    Attributes:
        speed: Highest forward speed.
        acceleration: Highest change of the forward speed.
        turn_rate: Highest rate of turn.
        turn_acceleration: Highest change of the rate of turn.
        reach: A waypoint this near is reached.
        facing: A robot whose waypoint is farther off its heading turns on the spot.
        gap: Distance kept to an obstacle ahead, from the hull.
    """

    speed: float = 0.8
    acceleration: float = 1.0
    turn_rate: float = 2.0
    turn_acceleration: float = 6.0
    reach: float = 0.04
    facing: float = 0.35
    gap: float = 0.08


@dataclass(frozen=True, slots=True)
class Pose:
    """A place and direction in the plane: metres, radians."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Twist:
    """A speed, metres a second forward, and a rate of turn, radians a second."""

    speed: float = 0.0
    turn_rate: float = 0.0


class Navigator:
    """Follows a list of waypoints.

    Args:
        limits: What the robot can do.
    """

    def __init__(self, limits: DriveLimits | None = None) -> None:
        self.limits = limits or DriveLimits()
        self._waypoints: list[tuple[float, float]] = []
        self._twist = Twist()
        self._turning = False

    @property
    def waypoints(self) -> Sequence[tuple[float, float]]:
        """What is left of the list, metres."""
        return self._waypoints

    @property
    def standing(self) -> bool:
        """Whether the robot was told to stand still in the last step."""
        return self._twist == Twist()

    @property
    def done(self) -> bool:
        """Whether the robot is at the end of its list and stands still."""
        return not self._waypoints and self.standing

    def follow(self, waypoints: Sequence[tuple[float, float]]) -> None:
        """Drive along these points instead, without stopping first."""
        self._waypoints = list(waypoints)

    def stop(self) -> None:
        """Brake, and forget the rest of the list."""
        self._waypoints = []

    def update(self, pose: Pose, dt: float, clear: float = inf) -> Twist:
        """The speeds to drive for the next ``dt`` seconds.

        Args:
            pose: Where the robot is.
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
            # Close by and already beside the robot: it cannot get nearer without turning back.
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
            sqrt(2 * limits.acceleration * max(away - limits.reach / 2, 0.0)),
            sqrt(2 * limits.acceleration * room),
        )
        # Close to a waypoint small errors of the pose are large errors of the bearing: go straight on there.
        gain = min(1.0, away / (6 * limits.reach))
        return Twist(speed * max(cos(error), 0.0), gain * max(-turn, min(turn, 3.0 * error)))


def _braking(angle: float, limits: DriveLimits) -> float:
    """The rate of turn from which a robot comes to rest after ``angle``, with half of its deceleration."""
    return sqrt(limits.turn_acceleration * angle)


def _towards(value: float, wanted: float, step: float) -> float:
    return value + max(-step, min(step, wanted - value))
