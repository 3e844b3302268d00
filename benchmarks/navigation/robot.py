"""A robot in the simulation with localization, ``move_base`` and safety stage, wired as its nodes wire them.

The parts run at the rates of ``configs/turtlebot``, in the world's time. A message arrives one tick of the
world after it was sent, and a plan a control step after it was asked for.
"""

from __future__ import annotations

from math import hypot
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.floor import TICK, Floor, shipped
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.localization.amcl import Amcl
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.observation import observe_scan
from rce_fleet.navigation.move_base.situation import Situation
from rce_fleet.navigation.move_base.stack import NavigationSettings, NavigationStack
from rce_fleet.navigation.safety.limiter import VelocityLimiter
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.navigation.safety.seen import Scan
from rce_fleet.nodes.amcl_parameters import AmclNodeParameters
from rce_fleet.nodes.move_base_parameters import read_settings
from rce_fleet.nodes.parameter_values import read_values

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.localization.scan import LaserScan
    from rce_fleet.navigation.move_base.core import Decision

LATENCY = 1
"""Ticks between a message and its arrival."""
SCAN_EVERY, ODOMETRY_EVERY, SAFETY_EVERY = 5, 2, 2
"""In ticks: 10 Hz scans, 25 Hz odometry and safety stage."""
FIRST_SPREAD = np.diag((0.05**2, 0.05**2, 0.05**2))
"""Covariance of the first pose, which is drawn from this distribution."""
WARM_UP = 0.5
"""Seconds until the first command, for the first scans."""


def settings() -> NavigationSettings:
    """Return the parameters of ``configs/turtlebot/move_base.yaml``."""
    found, problems = read_settings(shipped("move_base.yaml"))
    if problems:
        raise ValueError(problems[0].text)
    return found


class NavigatedRobot:
    """The robot of a floor with its navigation.

    Args:
        floor: Where it is.
        chosen: Parameters of ``move_base``.
        seed: Of the localization.

    Attributes:
        steps: CPU time of each control step: observations, costmaps, command; seconds.
        commands: What ``move_base`` commanded at each of them.
        errors: Error of the position at each of them, metres.
    """

    def __init__(self, floor: Floor, chosen: NavigationSettings, seed: int) -> None:
        self.floor = floor
        self.stack = NavigationStack(chosen)
        self.stack.global_costmap.set_map(floor.map)
        parameters, _ = read_values(AmclNodeParameters, shipped("amcl.yaml"))
        self.amcl = Amcl(floor.map, parameters, np.random.default_rng([seed, 1]))
        self.limiter = VelocityLimiter(SafetyParameters(), Footprint(SafetyParameters().robot_radius))
        self.steps: list[float] = []
        self.commands: list[Twist] = []
        self.errors: list[float] = []
        first = floor.robot.pose.as_array() + floor.rng.multivariate_normal(np.zeros(3), FIRST_SPREAD)
        self.amcl.set_pose(Pose.from_array(first), FIRST_SPREAD)
        self._map_from_odom = Pose.from_array(first)
        self._odometry = floor.robot.odometry
        self._speeds = Twist()
        self._scans: list[tuple[LaserScan, Pose, float]] = []
        self._global_at = float("-inf")
        self._ticks = 0
        self._coming: list[tuple[int, Callable[[], None]]] = []
        self._every = round(1 / chosen.move_base.controller_frequency / TICK)

    def run(self, goal: Pose, give_up: float) -> Decision | None:
        """Drive to a goal; return how it ended, None if it did not within ``give_up`` seconds."""
        while self.floor.world.time < WARM_UP:
            self._tick(None)
        self.stack.core.start(self.floor.world.time)
        begin = self.floor.world.time
        while self.floor.world.time - begin < give_up:
            decision = self._tick(goal)
            if decision is not None and decision.ending is not None:
                return decision
        return None

    def _tick(self, goal: Pose | None) -> Decision | None:
        floor, robot, now = self.floor, self.floor.robot, self.floor.world.time
        due = [call for tick, call in self._coming if tick <= self._ticks]
        self._coming = [one for one in self._coming if one[0] > self._ticks]
        for call in due:
            call()
        if self._ticks % ODOMETRY_EVERY == 0:
            odometry, speeds = robot.odometry, robot.wheels.wheels
            self._send(lambda: self._take_odometry(odometry, speeds, now))
        if self._ticks % SCAN_EVERY == 0:
            scan, place = floor.scan(), robot.odometry
            self._send(lambda: self._take_scan(scan, place, now))
        decision = None
        if goal is not None and self._ticks % self._every == 0:
            decision = self._control(goal)
        if self._ticks % SAFETY_EVERY == 0:
            self._pass_on()
        floor.step()
        self._ticks += 1
        return decision

    def _send(self, call: Callable[[], None], ticks: int = LATENCY) -> None:
        self._coming.append((self._ticks + ticks, call))

    # What comes in

    def _take_odometry(self, pose: Pose, speeds: Twist, stamp: float) -> None:
        self._odometry, self._speeds = pose, speeds
        self.limiter.take_pose(pose, stamp)

    def _take_scan(self, scan: LaserScan, place: Pose, stamp: float) -> None:
        estimate = self.amcl.update(place, scan)
        if estimate is not None:
            self._map_from_odom = estimate.map_from_odom
        sensor = place.compose(scan.laser)
        with np.errstate(invalid="ignore"):
            ranges = np.where(scan.ranges >= scan.range_max, np.inf, scan.ranges)
        self.limiter.take_scan(
            Scan(stamp, sensor, ranges, scan.angle_min, scan.angle_increment, scan.range_min)
        )
        self._scans.append((scan, sensor, stamp))

    # What goes out

    def _control(self, goal: Pose) -> Decision:
        stack, now, truth = self.stack, self.floor.world.time, self.floor.robot.pose
        pose, map_from_odom = self._odometry, self._map_from_odom
        at = map_from_odom.compose(pose)
        self.errors.append(hypot(at.x - truth.x, at.y - truth.y))
        began = process_time()
        self._observe()
        if now - self._global_at >= 1 / stack.global_costmap.parameters.update_frequency - TICK / 2:
            self._global_at = now
            stack.update_global(at, now)
        decision = stack.control(
            Situation(
                now=now,
                dt=self._every * TICK,
                pose=pose,
                measured=self._speeds,
                local_from_global=map_from_odom.inverse(),
            )
        )
        self.steps.append(process_time() - began)
        self.commands.append(decision.twist)
        self._send(lambda: self._command(decision.twist))
        if decision.wants_plan:
            plan = stack.plan(stack.snapshot(), at, goal)
            self._send(lambda: stack.core.take_plan(plan, self.floor.world.time), self._every)
        return decision

    def _observe(self) -> None:
        """Give the costmaps the scans that came."""
        stack = self.stack
        for scan, sensor, stamp in self._scans:
            limits = (scan.range_min, scan.range_max)
            for costmap, frame in (
                (stack.local_costmap, Pose(0.0, 0.0, 0.0)),
                (stack.global_costmap, self._map_from_odom),
            ):
                assert costmap.obstacles is not None
                for name, source in costmap.parameters.sources.items():
                    seen = observe_scan(
                        scan.ranges,
                        scan.angle_min,
                        scan.angle_increment,
                        limits,
                        frame.compose(sensor),
                        source,
                        stamp,
                    )
                    costmap.obstacles.take(name, seen)
        self._scans.clear()

    def _command(self, twist: Twist) -> None:
        self.limiter.take_command(twist, self.floor.world.time)
        self._pass_on()

    def _pass_on(self) -> None:
        passed = self.limiter.limit(self.floor.world.time).twist
        self._send(lambda: self.floor.robot.drive(passed))
