"""The local planner: follows a path within the robot's limits, and checks its footprint on the way exactly.

Regulated pure pursuit (Macenski et al., "Regulated Pure Pursuit for Robot Path Tracking", 2023) over several
lookahead distances and speeds: each pair is one trajectory, rolled out with the robot's accelerations, and
the cheapest one that keeps clear of obstacles is driven. A long lookahead distance is smooth; near obstacles,
where it would cut a corner, a short one follows the path as it is. With ``sampling: window`` the trajectories
are those of the dynamic window instead (Fox, Burgard and Thrun, 1997).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import atan2, ceil, copysign, cos, hypot, pi, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters
from rce_fleet.navigation.planners.path_follower import TrackedPath
from rce_fleet.navigation.planners.trajectories import free_steps, roll_out, stopping_distance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.navigation.costmap.footprint import Footprint

    Floats = NDArray[np.float64]

_LOOKAHEADS = (1.0, 0.75, 0.55, 0.4, 0.25)
"""Lookahead distances, as parts of the longest."""
_SPEEDS = (1.0, 0.7, 0.45, 0.25, 0.1)
"""Forward speeds, as parts of the highest."""
_WINDOW = (6, 15)
"""Samples of the dynamic window: forward speeds and turn rates."""
_TURN_DONE = 0.15
"""A turn on the spot ends when the path is this near to straight ahead, radians."""
_BRAKING_SHARE = 0.5
"""Share of the deceleration with which the robot slows down for its goal and for turns."""
_DEVIATION, _NEARNESS, _CHANGE = 0.5, 2.0, 0.03
"""Cost of a metre off the path, of a metre below the comfortable clearance, of a change of the turn rate."""


class Following(Enum):
    """How it goes."""

    DRIVING = "driving"
    BLOCKED = "blocked"
    REACHED = "reached"


@dataclass(frozen=True)
class ControlStep:
    """The result of a control step.

    Attributes:
        twist: The speeds to drive until the next step.
        following: Whether the robot drives, cannot go on, or stands at the goal.
        trajectory: Poses ahead that the command leads to, shape (T, 3).
    """

    twist: Twist
    following: Following
    trajectory: Floats


class LocalPlanner:
    """Follows a path.

    Args:
        parameters: Limits and settings.
        footprint: The robot's outline, with its padding.
    """

    def __init__(self, parameters: LocalPlannerParameters, footprint: Footprint) -> None:
        self.parameters = parameters
        self.footprint = footprint
        self._path: TrackedPath | None = None
        self._command = Twist()
        self._turning = False
        self._near_goal = False

    @property
    def path(self) -> TrackedPath | None:
        """The path that is followed."""
        return self._path

    def follow(self, path: Floats) -> None:
        """Follow a path, shape (N, 3), in the frame of the poses that :meth:`step` gets."""
        self._path = TrackedPath(path) if len(path) else None
        self._near_goal = False

    def move_path(self, path: Floats) -> None:
        """Replace the path by the same one in a frame that has moved."""
        if self._path is not None:
            self._path = self._path.moved(path)

    def stand(self) -> None:
        """Take note that the robot was stopped; the path and the progress on it stay."""
        self._command, self._turning = Twist(), False

    def reset(self) -> None:
        """Drop the path; the robot stands."""
        self.stand()
        self._path, self._near_goal = None, False

    def step(self, pose: Pose, measured: Twist, obstacles: Floats, dt: float) -> ControlStep:
        """Return the speeds for the next ``dt`` seconds.

        Args:
            pose: Where the robot is.
            measured: Its speeds by odometry.
            obstacles: Points of obstacles around it, shape (M, 2), metres.
            dt: Time until the next step, seconds.
        """
        now = self._speeds_now(measured)
        here = np.array(((pose.x, pose.y, pose.yaw),))
        near = obstacles[np.hypot(obstacles[:, 0] - pose.x, obstacles[:, 1] - pose.y) <= self._sight()]
        if self._path is None:
            return self._towards(now, Twist(), dt, Following.BLOCKED, here)
        self._path.advance(pose.x, pose.y, self.parameters.max_lookahead_dist)
        if self._is_at_goal(pose):
            return self._finish(pose, measured, now, near, dt)
        turn = self._turn_to_path(pose)
        if turn is not None:
            return self._turn(pose, now, turn, near, dt)
        step = self._drive(pose, now, near, dt)
        if step.following is Following.BLOCKED:
            off = self._bearing(pose, self.parameters.min_lookahead_dist)
            if abs(off) > _TURN_DONE:
                return self._turn(pose, now, off, near, dt)
        return step

    # Parts of a step

    def _sight(self) -> float:
        limits = self.parameters
        return (
            limits.max_vel_x * limits.sim_time
            + self.footprint.circumscribed_radius
            + limits.comfort_clearance
        )

    def _speeds_now(self, measured: Twist) -> Twist:
        """Return the last command, or the measured speeds if they are far from it: another stage braked."""
        limits, last = self.parameters, self._command
        speed, turn_rate = last.speed, last.turn_rate
        if abs(measured.speed - speed) > limits.acc_lim_x * limits.stop_time_buffer:
            speed = measured.speed
        if abs(measured.turn_rate - turn_rate) > limits.acc_lim_theta * limits.stop_time_buffer:
            turn_rate = measured.turn_rate
        return Twist(speed, turn_rate)

    def _towards(
        self, now: Twist, wanted: Twist, dt: float, following: Following, trajectory: Floats
    ) -> ControlStep:
        limits = self.parameters
        speed = _approach(now.speed, wanted.speed, limits.acc_lim_x * dt)
        turn_rate = _approach(now.turn_rate, wanted.turn_rate, limits.acc_lim_theta * dt)
        self._command = Twist(
            min(max(speed, min(now.speed, 0.0)), limits.max_vel_x),
            max(-limits.max_vel_theta, min(limits.max_vel_theta, turn_rate)),
        )
        return ControlStep(self._command, following, trajectory)

    def _is_at_goal(self, pose: Pose) -> bool:
        assert self._path is not None
        limits = self.parameters
        x, y, _ = self._path.poses[-1]
        away = hypot(x - pose.x, y - pose.y)
        if self._near_goal and limits.latch_xy_goal_tolerance:
            return True
        # Half of the tolerance to arrive, all of it to stay: turning must not carry the robot out again.
        self._near_goal = away <= limits.xy_goal_tolerance * (1.0 if self._near_goal else 0.6)
        rest = self._path.length - self._path.progress
        return self._near_goal and rest <= max(limits.max_lookahead_dist, limits.xy_goal_tolerance)

    def _finish(self, pose: Pose, measured: Twist, now: Twist, near: Floats, dt: float) -> ControlStep:
        """Brake, then turn to the goal's heading."""
        assert self._path is not None
        limits = self.parameters
        off = wrap(float(self._path.poses[-1, 2]) - pose.yaw)
        here = np.array(((pose.x, pose.y, pose.yaw),))
        if abs(off) > limits.yaw_goal_tolerance:
            return self._turn(pose, now, off, near, dt)
        step = self._towards(now, Twist(), dt, Following.DRIVING, here)
        stands = abs(measured.speed) <= limits.trans_stopped_vel
        stands = stands and abs(measured.turn_rate) <= limits.theta_stopped_vel
        if stands and step.twist == Twist():
            return ControlStep(step.twist, Following.REACHED, here)
        return step

    def _bearing(self, pose: Pose, lookahead: float) -> float:
        assert self._path is not None
        x, y = self._path.point(np.array((self._path.progress + lookahead,)))[0]
        if hypot(x - pose.x, y - pose.y) < 1e-6:  # noqa: PLR2004 - no direction
            return 0.0
        return wrap(atan2(y - pose.y, x - pose.x) - pose.yaw)

    def _turn_to_path(self, pose: Pose) -> float | None:
        """Return by how much to turn on the spot before the robot drives; None if it may drive."""
        limits = self.parameters
        off = self._bearing(pose, max(limits.min_lookahead_dist, limits.max_lookahead_dist / 3))
        self._turning = abs(off) > (_TURN_DONE if self._turning else limits.rotate_to_heading_min_angle)
        return off if self._turning else None

    def _turn(self, pose: Pose, now: Twist, off: float, near: Floats, dt: float) -> ControlStep:
        """Turn on the spot; a footprint that is not round must have room, or turn the other way round."""
        limits = self.parameters
        poses = _turned(pose, off)
        if not self.footprint.is_round and not self._has_room(pose, poses, near):
            off -= copysign(2 * pi, off)
            poses = _turned(pose, off)
            if not self._has_room(pose, poses, near):
                return self._towards(now, Twist(), dt, Following.BLOCKED, poses[:1])
        rate = sqrt(2 * _BRAKING_SHARE * limits.acc_lim_theta * abs(off))
        rate = min(max(rate, limits.min_vel_theta), limits.max_vel_theta, abs(off) / dt)
        wanted = Twist(0.0, copysign(rate, off) if abs(now.speed) < limits.trans_stopped_vel else 0.0)
        return self._towards(now, wanted, dt, Following.DRIVING, poses)

    def _has_room(self, pose: Pose, poses: Floats, near: Floats) -> bool:
        here = float(self.footprint.clearance(pose.as_array()[None, :], near)[0])
        clear = self.footprint.clearance(poses, near)[None, :]
        return bool(free_steps(clear, self.parameters.clearance, here)[0] == len(poses))

    def _drive(self, pose: Pose, now: Twist, near: Floats, dt: float) -> ControlStep:
        """Choose the best of the trajectories that keep clear of obstacles."""
        assert self._path is not None
        limits, path = self.parameters, self._path
        speeds, turn_rates = self._candidates(pose, now, dt)
        fastest = float(max(speeds.max(), abs(now.speed), 0.05))
        step = max(min(limits.sim_granularity / fastest, limits.sim_time / 4), limits.sim_time / 60)
        times = (ceil(limits.sim_time / step), step)
        acceleration = (limits.acc_lim_x, limits.acc_lim_theta)
        poses, driven = roll_out(pose, now, speeds, turn_rates, acceleration, times)
        many, count = poses.shape[:2]
        flat = np.concatenate((((pose.x, pose.y, pose.yaw),), poses.reshape(-1, 3)))
        clear = self.footprint.clearance(flat, near)
        clearances = clear[1:].reshape(many, count)
        free = free_steps(clearances, limits.clearance, float(clear[0]))
        rows = np.arange(many)
        way = np.where(free > 0, driven[rows, free - 1], 0.0)
        blocked = free < count
        reached = np.abs(
            now.speed + np.clip(speeds - now.speed, -limits.acc_lim_x * dt, limits.acc_lim_x * dt)
        )
        needed = stopping_distance(reached, limits.acc_lim_x, limits.stop_time_buffer + dt)
        possible = ~blocked | (way >= needed)
        ends = poses[rows, np.maximum(free - 1, 0)]
        along, off = path.project(ends[:, :2], limits.max_vel_x * limits.sim_time + limits.max_lookahead_dist)
        gained = np.where(free > 0, along - path.progress, 0.0)
        soon = np.minimum(clearances[:, : max(1, count // 2)].min(axis=1), limits.comfort_clearance)
        cost = (
            -gained
            + _DEVIATION * off
            + _NEARNESS * (limits.comfort_clearance - soon)
            + _CHANGE * np.abs(turn_rates - now.turn_rate)
        )
        cost = np.where(possible & (gained > limits.sim_granularity), cost, np.inf)
        best = int(cost.argmin())
        if not np.isfinite(cost[best]):
            return self._towards(now, Twist(), dt, Following.BLOCKED, flat[:1])
        chosen = Twist(float(speeds[best]), float(turn_rates[best]))
        return self._towards(now, chosen, dt, Following.DRIVING, poses[best, : max(int(free[best]), 1)])

    # Trajectories to look at

    def _candidates(self, pose: Pose, now: Twist, dt: float) -> tuple[Floats, Floats]:
        """Return forward speeds and turn rates, both of shape (K,)."""
        assert self._path is not None
        limits, path = self.parameters, self._path
        goal_x, goal_y, _ = path.poses[-1]
        rest = max(path.length - path.progress, hypot(goal_x - pose.x, goal_y - pose.y))
        highest = min(limits.max_vel_x, sqrt(2 * _BRAKING_SHARE * limits.acc_lim_x * rest))
        if limits.sampling == "window":
            return _window(now, highest, limits, dt)
        longest = limits.lookahead_time * abs(now.speed)
        longest = min(max(longest, limits.min_lookahead_dist * 2), limits.max_lookahead_dist)
        ahead = np.maximum(longest * np.array(_LOOKAHEADS), limits.min_lookahead_dist)
        points = path.point(path.progress + ahead) - (pose.x, pose.y)
        across = points[:, 1] * cos(pose.yaw) - points[:, 0] * sin(pose.yaw)
        curvature = 2 * across / np.maximum((points**2).sum(axis=1), 1e-6)
        fastest = np.minimum(highest, limits.max_vel_theta / np.maximum(np.abs(curvature), 1e-6))
        speeds = (fastest[:, None] * np.array(_SPEEDS)).reshape(-1)
        return speeds, speeds * np.repeat(curvature, len(_SPEEDS))


def _window(now: Twist, highest: float, limits: LocalPlannerParameters, dt: float) -> tuple[Floats, Floats]:
    """Return the samples of the dynamic window of the next half second."""
    reach = max(dt, 0.5)
    speeds = np.linspace(
        max(0.02, now.speed - limits.acc_lim_x * reach),
        max(0.03, min(highest, now.speed + limits.acc_lim_x * reach)),
        _WINDOW[0],
    )
    turns = np.linspace(
        max(-limits.max_vel_theta, now.turn_rate - limits.acc_lim_theta * reach),
        min(limits.max_vel_theta, now.turn_rate + limits.acc_lim_theta * reach),
        _WINDOW[1],
    )
    turns = np.append(turns, 0.0)
    return np.repeat(speeds, len(turns)), np.tile(turns, len(speeds))


def _turned(pose: Pose, off: float) -> Floats:
    """Return the poses of a turn on the spot, 5 degrees apart, shape (T, 3)."""
    count = max(2, ceil(abs(off) / (pi / 36)))
    yaws = pose.yaw + off * np.arange(1, count + 1) / count
    return np.stack((np.full(count, pose.x), np.full(count, pose.y), yaws), axis=1)


def _approach(value: float, wanted: float, step: float) -> float:
    return value + max(-step, min(step, wanted - value))
