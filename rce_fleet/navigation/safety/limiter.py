"""The safety stage: of each command it passes as much as the latest scan allows.

The robot must be able to stop before any obstacle that its scan shows, on the arc that it drives, with its
real deceleration and all delays::

    v (delay + age of the scan) + v^2 / (2 deceleration) <= free distance - margin

In front of something that moves it must also leave the distance by which that may come nearer meanwhile (the
separation of ISO 13855, with ``walking_speed``). A command, scan or pose that is late stops the robot, and so
does an emergency stop until it is released.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, hypot, inf, isfinite, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap_array
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.planners.trajectories import free_steps, stopping_distance
from rce_fleet.navigation.safety.seen import Scan, SeenPoints, in_frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.navigation.costmap.footprint import Footprint
    from rce_fleet.navigation.safety.parameters import SafetyParameters

    Floats = NDArray[np.float64]

_STEP = 0.01
"""Length of the steps in which an arc is looked at, metres."""
_ANGLE_STEP = pi / 180
"""Angle of the steps of a turn on the spot, radians."""
_STILL = 1e-3
"""A forward speed below this is a turn on the spot, m/s."""
_OWN_BODY = 0.05
"""Points deeper inside the outline than this are the robot itself, such as a mast, metres."""
_JUMP = 1.0
"""Odometry that moves by more than this between two poses has jumped, metres."""
_TIME_JUMP = 0.1
"""Time that goes back by more than this was set anew, seconds."""
_VIEW = pi / 18
"""A scan tells of a direction if one of its beams this near to it does, radians."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What passes of a command.

    Attributes:
        twist: The speeds for the wheels.
        reason: Why they are less than commanded; empty if they are not.
        stopped: Whether the robot is stopped because it cannot know better, or by an emergency stop.
    """

    twist: Twist
    reason: str = ""
    stopped: bool = False


STANDING = Twist()
_BESIDE = "an obstacle is beside the robot"


class VelocityLimiter:
    """Limits commands by what the robot's sensors show.

    Args:
        parameters: Of the stage.
        footprint: The robot's outline.

    Attributes:
        speed_limit: Highest speed where the robot is, metres per second; infinity: the stage's own.
    """

    def __init__(self, parameters: SafetyParameters, footprint: Footprint) -> None:
        self.parameters = parameters
        self.footprint = footprint
        self._stops: dict[str, str] = {}
        """Why the robot is stopped, by the way on which it was."""
        self.speed_limit = inf
        self.seen = SeenPoints(parameters.memory)
        self._command = STANDING
        self._commanded_at = float("-inf")
        self._pose: Pose | None = None
        self._posed_at = float("-inf")
        self._now = float("-inf")

    @property
    def emergency(self) -> str:
        """Why the robot is stopped until :meth:`release`; empty if it is not."""
        return "; ".join(self._stops.values())

    # What comes in

    def take_command(self, twist: Twist, now: float) -> None:
        """Take a command. One that is not finite counts as a command to stand."""
        self._note_time(now)
        valid = isfinite(twist.speed) and isfinite(twist.turn_rate)
        self._command = twist if valid else STANDING
        self._commanded_at = now

    def take_pose(self, pose: Pose, stamp: float) -> None:
        """Take the robot's pose in the odometry's frame; one that jumps makes all points obsolete."""
        known = self._pose
        if known is not None and hypot(pose.x - known.x, pose.y - known.y) > _JUMP:
            self.seen.forget()
        self._pose, self._posed_at = pose, stamp

    def take_scan(self, scan: Scan) -> None:
        """Take a scan."""
        self.seen.take(scan)

    def stop(self, reason: str, way: str = "") -> None:
        """Stop the robot until :meth:`release` is called for the same way.

        Args:
            reason: Why.
            way: How the stop came, such as the name of a topic. The robot stands while any way stops it.
        """
        self._stops[way] = reason or "emergency stop"

    def release(self, way: str = "") -> None:
        """End the emergency stop of a way. Commands from before do not count any more."""
        if self._stops.pop(way, None) is not None:
            self._commanded_at = float("-inf")

    # What goes out

    def limit(self, now: float) -> Verdict:
        """Return the speeds for the wheels at a time."""
        self._note_time(now)
        problem = self._problem(now)
        if problem:
            return Verdict(STANDING, problem, stopped=True)
        assert self._pose is not None
        limits, command = self.parameters, self._command
        twist = _shortened(command, min(limits.max_speed, self.speed_limit), limits.max_turn_rate)
        if twist == STANDING:
            return Verdict(twist)
        scan = self.seen.newest
        assert scan is not None
        delay = limits.delay + max(now - scan.stamp, 0.0)
        points = in_frame(self._pose, self.seen.points)
        points = points[self.footprint.distances(points) > -_OWN_BODY]
        if abs(twist.speed) < _STILL:
            share, reason = self._limit_turn(twist, points, delay)
        else:
            share, reason = self._limit_drive(twist, points, delay)
        passed = Twist(twist.speed * share, twist.turn_rate * share)
        return Verdict(passed, reason if share < 1 else "")

    def _note_time(self, now: float) -> None:
        """Forget all inputs when time was set back: by their stamps they would not become late."""
        if now < self._now - _TIME_JUMP:
            self.seen.forget()
            self._pose = None
            self._commanded_at = self._posed_at = float("-inf")
        self._now = now

    def _problem(self, now: float) -> str:
        limits = self.parameters
        if self.emergency:
            return self.emergency
        if now - self._commanded_at > limits.command_timeout:
            return f"no command for {limits.command_timeout:.2f} s"
        scan = self.seen.newest
        if scan is None:
            return "no scan yet"
        if now - scan.stamp > limits.scan_timeout:
            return f"the last scan is {now - scan.stamp:.2f} s old (limit {limits.scan_timeout:.2f} s)"
        if now - self._posed_at > limits.transform_timeout:
            return f"no transform or odometry for {limits.transform_timeout:.2f} s"
        return ""

    def _limit_drive(self, twist: Twist, points: Floats, delay: float) -> tuple[float, str]:
        """Return the share of a command that passes, and why not more."""
        limits = self.parameters
        speed, curvature = abs(twist.speed), abs(twist.turn_rate / twist.speed)
        turns = not self.footprint.is_round and curvature > 0
        reach = float(stopping_distance(speed, limits.deceleration, delay))
        if turns:  # The corners swing until the turn has ended too, which may take longer.
            angle = float(stopping_distance(twist.turn_rate, limits.angular_deceleration, delay))
            reach = max(reach, angle / curvature)
        free = self.free_distance(twist, points, reach)
        allowed, reason = speed, ""
        if free < reach:
            allowed = min(speed, allowed_speed(free, limits.deceleration, delay))
            reason = f"an obstacle is {free + limits.margin:.2f} m ahead"
            if turns:
                rate = allowed_speed(free * curvature, limits.angular_deceleration, delay)
                if rate / curvature < allowed:
                    allowed, reason = rate / curvature, _BESIDE
        unseen = limits.unseen_speed
        if allowed > unseen and not self._is_seen(0.0 if twist.speed > 0 else pi):
            allowed, reason = unseen, "no scan tells of the direction"
        if limits.walking_speed > 0:
            assert self._pose is not None
            beside = self._allowed_beside_moving(twist, in_frame(self._pose, self.seen.moving), delay)
            if beside < allowed:
                allowed, reason = beside, "something moves near the robot"
        return min(1.0, allowed / speed), reason

    def _limit_turn(self, twist: Twist, points: Floats, delay: float) -> tuple[float, str]:
        if self.footprint.is_round:
            return 1.0, ""
        limits = self.parameters
        rate = abs(twist.turn_rate)
        reach = float(stopping_distance(rate, limits.angular_deceleration, delay))
        count = max(1, ceil(reach / _ANGLE_STEP))
        yaws = np.sign(twist.turn_rate) * reach * np.arange(count + 1) / count
        poses = np.stack((np.zeros(count + 1), np.zeros(count + 1), yaws), axis=1)
        free = self._free_share(poses, points) * reach
        if free >= reach:
            return 1.0, ""
        return allowed_speed(free, limits.angular_deceleration, delay) / rate, _BESIDE

    def free_distance(self, twist: Twist, points: Floats, reach: float) -> float:
        """Return how far the robot can drive on an arc until it is ``margin`` from an obstacle, metres.

        Args:
            twist: Its forward speed, which is not 0, and its turn rate.
            points: Obstacles in its own frame, shape (M, 2), metres.
            reach: How far to look, metres.
        """
        sight = reach + self.footprint.circumscribed_radius + self.parameters.margin
        near = points[np.hypot(*points.T) <= sight]
        direction = np.sign(twist.speed)
        curvature = twist.turn_rate / twist.speed
        count = max(1, ceil(reach / _STEP))
        if not self.footprint.is_round:
            count = max(count, ceil(reach * abs(curvature) / _ANGLE_STEP))
        driven = reach * np.arange(count + 1) / count
        yaws = direction * driven * curvature
        chord = direction * driven * np.sinc(yaws / 2 / np.pi)
        poses = np.stack((chord * np.cos(yaws / 2), chord * np.sin(yaws / 2), yaws), axis=1)
        return self._free_share(poses, near) * reach

    def _free_share(self, poses: Floats, points: Floats) -> float:
        """Return the share of the steps of an arc, the first of which is the present pose, that is free."""
        margin = self.parameters.margin
        clear = self.footprint.clearance(poses, points, enough=margin + 2 * _STEP)
        free = int(free_steps(clear[None, 1:], margin, float(clear[0]))[0])
        return free / (len(poses) - 1)

    def _allowed_beside_moving(self, twist: Twist, moving: Floats, delay: float) -> float:
        """Return the speed at which the robot stops before something that comes nearer reaches it."""
        ahead = moving[moving[:, 0] * np.sign(twist.speed) > 0]
        if not len(ahead):
            return float("inf")
        limits = self.parameters
        clear = float(self.footprint.clearance(np.zeros((1, 3)), ahead, enough=3.0)[0]) - limits.margin
        # v (delay + walking / deceleration) + v^2 / (2 deceleration) <= clear - walking * delay
        slow = delay + limits.walking_speed / limits.deceleration
        return allowed_speed(clear - limits.walking_speed * delay, limits.deceleration, slow)

    def _is_seen(self, direction: float) -> bool:
        """Return whether the newest scan tells of a direction, seen from the robot.

        Beams that are NaN tell nothing: a lidar that is covered, or something nearer than it can measure.
        """
        scan, pose = self.seen.newest, self._pose
        assert scan is not None
        assert pose is not None
        step = abs(scan.angle_increment)
        beams = scan.sensor.yaw + scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        off = np.abs(wrap_array(beams - direction - pose.yaw))
        if not (off <= step).any():
            return False
        tells = off <= max(step, _VIEW)
        return self.parameters.missing_is_free or bool((tells & ~np.isnan(scan.ranges)).any())


def allowed_speed(free: float, deceleration: float, delay: float) -> float:
    """Return the highest speed from which a robot stops within a distance.

    It is the solution of ``v delay + v^2 / (2 deceleration) = free``.

    Args:
        free: Metres, or radians for a turn.
        deceleration: Per second squared.
        delay: Time until the brakes take hold, seconds.
    """
    if free <= 0:
        return 0.0
    lost = deceleration * delay
    return sqrt(lost * lost + 2 * deceleration * free) - lost


def _shortened(twist: Twist, speed: float, turn_rate: float) -> Twist:
    """Return a command on the same arc whose speeds are within limits."""
    share = 1.0
    if abs(twist.speed) > speed:
        share = speed / abs(twist.speed)
    if abs(twist.turn_rate) > turn_rate:
        share = min(share, turn_rate / abs(twist.turn_rate))
    return Twist(twist.speed * share, twist.turn_rate * share)
