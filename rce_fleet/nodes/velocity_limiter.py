"""The safety stage between planner and wheels, as a node. Runs on the robot, in its namespace.

It subscribes to ``raw_cmd_vel``, ``scan`` and ``odom`` (or tf), and publishes ``cmd_vel``. A number on
``speed_limit`` is the highest speed that passes, in m/s, until another comes; 0 ends it. A message true on
``emergency_stop``, or the service ``~set_emergency_stop``, stops the robot until false releases it on the
same way: a release that comes again when a network is back does not end a stop that was made at the robot.
A time on ``drive_clock``, which a station sends before each velocity of an operator, is answered on
``drive_echo``; while such times come late, commands are taken for stops. The work is done by
:mod:`rce_fleet.navigation.safety`.
"""

from __future__ import annotations

from math import isfinite
from time import monotonic
from typing import Any

import numpy as np

from rce.ros.node import Message, Node, Publisher, run
from rce.ros.tf import TransformError, TransformListener
from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.navigation import read_speed_limit
from rce_fleet.navigation.safety.drive_clock import DriveClock
from rce_fleet.navigation.safety.limiter import STANDING, VelocityLimiter, Verdict
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.navigation.safety.seen import Scan, sensor_pose
from rce_fleet.navigation.scans import fault_of_scan, fault_of_stamp
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import angles_from_above, pose_of, read_pose, read_twist, twist_fields
from rce_fleet.nodes.robot_place import full_name, named_in_message
from rce_fleet.nodes.throttled_log import ThrottledLog

DIAGNOSTICS_EVERY = 1.0
"""Seconds between two messages on ``/diagnostics``."""


class VelocityLimiterNode:
    """The safety stage in a ROS graph.

    Args:
        node: Running node, in the robot's namespace.
        parameters: Of the stage.
    """

    def __init__(self, node: Node, parameters: SafetyParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._throttled_log = ThrottledLog(node)
        self._unsafe = ""
        """Why no command may pass: the robot's outline is not known."""
        try:
            footprint = Footprint.read(
                parameters.footprint, parameters.robot_radius, parameters.footprint_padding
            )
        except ValueError as error:
            self._unsafe = f"the parameters of the outline cannot be used: {error}"
            footprint = Footprint(SafetyParameters().robot_radius)
        self._limiter = VelocityLimiter(parameters, footprint)
        self._odometry: list[tuple[float, Pose]] = []
        self._last = Verdict(STANDING)
        self._limited = 0
        self._watch = OdometryWatch()
        self._drive_clock = DriveClock()
        self._faults: dict[str, str] = {}
        """Why the last scan and the last odometry cannot be used."""
        self._tf: TransformListener
        self._out: Publisher
        self._echo: Publisher
        self._stopped: Publisher

    async def run(self) -> None:
        """Pass commands until the node is stopped."""
        node = self._node
        self._out = await node.advertise("cmd_vel", "geometry_msgs/Twist", queue_size=1)
        self._echo = await node.advertise("drive_echo", "std_msgs/Float64", queue_size=1)
        self._stopped = await node.advertise("~emergency_stopped", "std_msgs/Bool", latch=True)
        self._stopped.publish(data=False)
        diagnostics = await Diagnostics.start(node, "velocity_limiter: safety")
        try:
            await self._limit(diagnostics)
        finally:  # Also after an error: wheels keep their last command.
            self._limiter.stop("the safety stage has ended")
            self._out.publish(twist_fields(STANDING))

    async def _limit(self, diagnostics: Diagnostics) -> None:
        node = self._node
        async with TransformListener(node, prefix="") as self._tf:
            await node.subscribe("odom", "nav_msgs/Odometry", self._take_odometry)
            await node.subscribe("scan", "sensor_msgs/LaserScan", self._take_scan)
            await node.subscribe("raw_cmd_vel", "geometry_msgs/Twist", self._take_command)
            await node.subscribe("drive_clock", "std_msgs/Float64", self._take_clock)
            await node.subscribe("emergency_stop", "std_msgs/Bool", self._take_stop)
            await node.subscribe("speed_limit", "std_msgs/Float64", self._take_speed_limit)
            await node.advertise_service("~set_emergency_stop", "std_srvs/SetBool", self._answer_stop)
            told = float("-inf")
            async for _ in node.rate(self._parameters.frequency):
                self._pass_on()
                now = node.time()
                if not 0 <= now - told < DIAGNOSTICS_EVERY:
                    told = now
                    self._report(diagnostics)

    # What comes in

    def _take_command(self, message: Message) -> None:
        twist = read_twist(message)
        if not (isfinite(twist.speed) and isfinite(twist.turn_rate)):
            self._throttled_log.warn(
                "command", f"a command of {twist.speed} m/s and {twist.turn_rate} rad/s is taken for a stop"
            )
        if self._drive_clock.is_late(monotonic()):
            self._throttled_log.warn("late", "commands of the operator are late: they are taken for stops")
            twist = STANDING
        self._limiter.take_command(twist, self._node.time())
        self._pass_on()

    def _take_clock(self, message: Message) -> None:
        if self._drive_clock.take(message.data, monotonic()):
            self._echo.publish(data=message.data)

    def _take_speed_limit(self, message: Message) -> None:
        try:
            self._limiter.speed_limit = read_speed_limit(message.data)
        except ValueError as error:
            self._throttled_log.warn("speed_limit", str(error))

    def _take_odometry(self, message: Message) -> None:
        try:
            pose = read_pose(message.pose.pose)
        except ValueError as error:
            self._refuse("odom", f"odometry is ignored: {error}")
            return
        stamp, now = message.header.stamp.to_sec(), self._node.time()
        fault = fault_of_stamp(stamp, now, self._parameters.transform_timeout)
        if fault:
            self._refuse("odom", f"odometry is ignored: {fault}")
            return
        jump = self._watch.check(pose, stamp)
        if jump:
            self._throttled_log.warn("jump", f"{jump}; what was seen before is forgotten")
            self._limiter.seen.forget()
        if jump or (self._odometry and stamp < self._odometry[-1][0]):
            self._odometry.clear()  # Scans from now on must not be placed by poses from before.
        self._limiter.take_pose(pose, stamp)
        self._faults.pop("odom", None)
        self._odometry.append((stamp, pose))
        del self._odometry[:-200]

    def _take_scan(self, message: Message) -> None:
        angles = (message.angle_min, message.angle_max, message.angle_increment)
        limits = (message.range_min, message.range_max)
        stamp, now = message.header.stamp.to_sec(), self._node.time()
        fault = fault_of_scan(len(message.ranges), angles, limits)
        fault = fault or fault_of_stamp(stamp, now, self._parameters.scan_timeout)
        at = self._pose_at(stamp)
        if not fault and at is None:
            fault = "there is no odometry at its time"
        try:
            mounted = self._tf.lookup(
                full_name(self._tf, self._parameters.robot_base_frame),
                named_in_message(message.header.frame_id),
            )
        except TransformError as error:
            fault = fault or str(error)
        if fault:
            self._refuse("scan", f"a scan of {self._node.resolve('scan')} is ignored: {fault}")
            return
        self._faults.pop("scan", None)
        assert at is not None
        ranges = np.asarray(message.ranges, np.float64)
        with np.errstate(invalid="ignore"):
            ranges = np.where(ranges >= limits[1], np.inf, ranges)
            ranges = np.where(ranges < limits[0], np.nan, ranges)
        sensor = Pose.from_array(sensor_pose(at, pose_of(mounted.transform)))
        first, step = angles_from_above(mounted.transform, angles[0], angles[2])
        self._limiter.take_scan(Scan(stamp, sensor, ranges, first, step, limits[0]))

    def _refuse(self, subject: str, text: str) -> None:
        self._faults[subject] = text
        self._throttled_log.warn(subject, text)

    def _pose_at(self, stamp: float) -> Pose | None:
        """Return the odometry nearest to a time."""
        if not self._odometry:
            return None
        return min(self._odometry, key=lambda known: abs(known[0] - stamp))[1]

    # Emergency stop

    def _halt(self, way: str, *, stop: bool) -> str:
        """Stop the robot, or end the stop of this way; return what holds now."""
        limiter, before = self._limiter, self._limiter.emergency
        way = self._node.resolve(way)
        if stop:
            limiter.stop(f"emergency stop by {way}", way)
            self._node.log.error("emergency stop by %s: the robot stands until false releases it there", way)
        else:
            limiter.release(way)
        text = f"stopped: {limiter.emergency}" if limiter.emergency else "released"
        if not stop and limiter.emergency != before:
            self._node.log.warning("the emergency stop by %s was ended; the robot is %s", way, text)
        self._stopped.publish(data=bool(limiter.emergency))
        self._pass_on()
        return text

    def _take_stop(self, message: Message) -> None:
        self._halt("emergency_stop", stop=message.data)

    def _answer_stop(self, request: Message) -> dict[str, Any]:
        return {"success": True, "message": self._halt("~set_emergency_stop", stop=request.data)}

    # What goes out

    def _pass_on(self) -> None:
        if self._node.is_shutdown:
            return
        verdict = self._limiter.limit(self._node.time())
        if self._unsafe:
            verdict = Verdict(STANDING, self._unsafe, stopped=True)
        if verdict.stopped and not self._last.stopped and "no command" not in verdict.reason:
            self._throttled_log.warn("stop", f"the robot stands: {verdict.reason}")
        self._limited += bool(verdict.reason and not verdict.stopped)
        self._last = verdict
        self._out.publish(twist_fields(verdict.twist))

    def _report(self, diagnostics: Diagnostics) -> None:
        verdict = self._last
        idle = verdict.stopped and "no command" in verdict.reason
        level = Level.OK if not verdict.stopped or idle else Level.ERROR
        scan = self._limiter.seen.newest
        age = self._node.time() - scan.stamp if scan is not None else float("inf")
        reason = verdict.reason or "commands pass"
        if verdict.stopped and not self._limiter.emergency:
            reason = "; ".join((reason, *self._faults.values()))
        diagnostics.publish(
            level,
            reason,
            {
                "speed": f"{verdict.twist.speed:.3f}",
                "turn rate": f"{verdict.twist.turn_rate:.3f}",
                "age of the scan": f"{age:.3f}" if isfinite(age) else "no scan",
                "limited commands": str(self._limited),
                "emergency stop": self._limiter.emergency or "no",
                "speed limit": f"{limit:.3f}" if isfinite(limit := self._limiter.speed_limit) else "none",
            },
        )


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("velocity_limiter") as node:
        await VelocityLimiterNode(node, await read_parameters(node, SafetyParameters)).run()


if __name__ == "__main__":
    run(main())
