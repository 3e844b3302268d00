"""The hardware of a simulated robot as a ROS node: its sensors and wheels.

Topics, relative to the node's namespace: publishes ``scan``, ``odom``, ``battery_state``,
``mobile_base/events/bumper`` and ``ground_truth/pose``; subscribes to ``cmd_vel`` and ``computing_load``. It
publishes ``odom`` -> ``base_link`` on ``/tf``, the sensor's frame on ``/tf_static``, and ``/diagnostics``.
Only judges of a run may read ``ground_truth/pose``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rce.ros.tf import StampedTransform, Transform, frames
from rce.ros.tf.broadcaster import KIND, TF, TF_STATIC
from rce.ros.types import Message, Time
from rce_fleet.drivers.fields import (
    ERROR,
    OK,
    battery_diagnosis,
    battery_fields,
    pose_fields,
    scan_fields,
    transform_of,
    twist_fields,
)
from rce_fleet.drivers.stand_in import StandIn
from rce_fleet.geometry.poses import Twist

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.node import Node, Publisher
    from rce_fleet.navigation.navigation import DriveLimits
    from rce_fleet.simulation.lidar import Floats
    from rce_fleet.simulation.world import World

REPORT_EVERY = 1.0
"""Seconds between two messages about the battery, and between two diagnoses."""
TRUTH_EVERY = 0.1
"""Seconds between two true poses."""
SIDE = math.radians(30)
"""A contact farther to the side than this is at the left or right bumper, radians."""
FRONT = math.radians(90)
"""Bumpers reach so far to both sides of the front, radians."""
LEFT, CENTER, RIGHT = 0, 1, 2
_EPSILON = 1e-6


@dataclass(slots=True)
class _Topics:
    """The node's publishers."""

    odometry: Publisher
    scan: Publisher
    frames: Publisher
    battery: Publisher
    bumper: Publisher
    diagnostics: Publisher
    truth: Publisher


class RobotDriver:
    """Runs one robot of a world as a node.

    The caller calls :meth:`update` after every step of the world.

    Args:
        node: Running node; its namespace is the robot's.
        world: The world.
        robot: Id of the robot in the world.
        limits: Speeds and accelerations of the stand-in.
        tf_prefix: Prefix of the robot's frames, if several robots share a graph.
        stand_in: Whether the node also stands for ``amcl`` and ``move_base``.
        now: Returns the time for stamps; the machine's clock if None.
    """

    def __init__(
        self,
        node: Node,
        world: World,
        robot: str,
        limits: DriveLimits | None = None,
        *,
        tf_prefix: str = "",
        stand_in: bool = True,
        now: Callable[[], Time] | None = None,
    ) -> None:
        self._node = node
        self._world = world
        self._robot = world.robots[robot]
        self._now = now or Time.now
        self._stand_in = StandIn(node, world.grid, self._robot, limits) if stand_in else None
        self._sensor = self._robot.model.lidar
        self._odom, self._base_link, self._sensor_frame = (
            frames.resolve(tf_prefix, frame) for frame in ("odom", "base_link", self._sensor.frame)
        )
        self._topics: _Topics | None = None
        self._due: dict[str, float] = {}
        self._pressed: set[int] = set()
        self._commanded_at = -math.inf

    @property
    def robot(self) -> str:
        """Id of the robot."""
        return self._robot.id

    async def start(self) -> None:
        """Create publishers and subscribers. They end with the node."""
        node = self._node
        self._topics = _Topics(
            odometry=await node.advertise("odom", "nav_msgs/Odometry"),
            scan=await node.advertise("scan", "sensor_msgs/LaserScan"),
            frames=await node.advertise(TF, KIND),
            battery=await node.advertise("battery_state", "sensor_msgs/BatteryState"),
            bumper=await node.advertise("mobile_base/events/bumper", "kobuki_msgs/BumperEvent"),
            diagnostics=await node.advertise("/diagnostics", "diagnostic_msgs/DiagnosticArray"),
            truth=await node.advertise("ground_truth/pose", "nav_msgs/Odometry"),
        )
        static = await node.advertise(TF_STATIC, KIND, latch=True)
        spec = self._sensor
        mount = Transform.make(spec.x, spec.y, spec.z, yaw=spec.yaw)
        edge = StampedTransform(self._base_link, self._sensor_frame, mount, self._now())
        static.publish(transforms=[edge.fields])
        await node.subscribe("cmd_vel", "geometry_msgs/Twist", self._take_command)
        await node.subscribe("computing_load", "std_msgs/Float32", self._take_load)
        if self._stand_in is not None:
            await self._stand_in.start()

    def reset(self) -> None:
        """Begin anew with the world's time."""
        self._due.clear()
        self._pressed.clear()
        self._commanded_at = -math.inf
        if self._stand_in is not None:
            self._stand_in.reset(self._world.time)

    @property
    def wants_scan(self) -> bool:
        """Whether the next :meth:`update` needs a scan."""
        if self._stand_in is None and (self._topics is None or not self._topics.scan.connections):
            return False
        return self._world.time >= self._due.get("scan", -math.inf) - _EPSILON

    def update(self, ranges: Floats | None = None) -> None:
        """Publish sensors and drive; call it after a step of the world.

        Args:
            ranges: The robot's scan if :attr:`wants_scan`; it is made here if None.
        """
        topics = self._topics
        if topics is None:
            return
        now, stamp = self._world.time, self._now()
        scans = self.wants_scan
        if scans:
            self._is_due("scan", 1.0 / self._sensor.rate)
        # A scan's odometry is exact: it is not between two messages.
        if self._is_due("odometry", 1.0 / self._robot.model.odometry.rate) or scans:
            self._publish_odometry(topics, stamp)
        if scans:
            self._scan(topics, stamp, self._world.scan(self._robot.id) if ranges is None else ranges)
        if self._is_due("truth", TRUTH_EVERY) and topics.truth.connections:
            self._publish_truth(topics, stamp)
        self._publish_bumper(topics)
        if self._is_due("report", REPORT_EVERY):
            self._report(topics, stamp)
        if self._stand_in is not None and self._is_due("control", _CONTROL_EVERY):
            self._stand_in.update(now, stamp)

    # What comes in

    def _take_command(self, message: Message) -> None:
        speed, turn = message.linear.x, message.angular.z
        if not (math.isfinite(speed) and math.isfinite(turn)):
            self._node.log.error(
                "cmd_vel: speeds must be finite numbers, not %s and %s; ignored", speed, turn
            )
            return
        self._commanded_at = self._world.time
        self._robot.drive(Twist(speed, turn))

    def _take_load(self, message: Message) -> None:
        load = message.data
        if not 0 <= load <= 1:
            self._node.log.error("computing_load: must be within 0 .. 1, not %s; ignored", load)
            return
        self._robot.battery.computing_load = load

    # What goes out

    def _is_due(self, what: str, period: float) -> bool:
        """Return whether something periodic is due; if so, note when it is due again."""
        now = self._world.time
        due = self._due.get(what, now)
        if now < due - _EPSILON:
            return False
        self._due[what] = max(due + period, now)
        return True

    def _scan(self, topics: _Topics, stamp: Time, ranges: Floats) -> None:
        if topics.scan.connections:
            topics.scan.publish(
                header={"stamp": stamp, "frame_id": self._sensor_frame}, **scan_fields(self._sensor, ranges)
            )
        if self._stand_in is not None:
            self._stand_in.sense(stamp, ranges)

    def _publish_odometry(self, topics: _Topics, stamp: Time) -> None:
        robot = self._robot
        if topics.frames.connections:
            edges = [StampedTransform(self._odom, self._base_link, transform_of(robot.odometry), stamp)]
            if self._stand_in is not None:
                edges.append(self._stand_in.map_from_odom(self._odom, stamp))
            topics.frames.publish(transforms=[edge.fields for edge in edges])
        if topics.odometry.connections:
            topics.odometry.publish(
                header={"stamp": stamp, "frame_id": self._odom},
                child_frame_id=self._base_link,
                pose={"pose": pose_fields(robot.odometry)},
                twist={"twist": twist_fields(robot.wheels.wheels)},
            )

    def _publish_truth(self, topics: _Topics, stamp: Time) -> None:
        topics.truth.publish(
            header={"stamp": stamp, "frame_id": "map"},
            child_frame_id=self._base_link,
            pose={"pose": pose_fields(self._robot.pose)},
            twist={"twist": twist_fields(self._robot.twist)},
        )

    def _publish_bumper(self, topics: _Topics) -> None:
        """Publish the bumpers that were pressed or released."""
        pressed = set()
        for bearing in self._world.touched(self._robot.id):
            if abs(bearing) <= FRONT:
                pressed.add(CENTER if abs(bearing) <= SIDE else LEFT if bearing > 0 else RIGHT)
        for bumper in sorted(pressed ^ self._pressed):
            topics.bumper.publish(bumper=bumper, state=int(bumper in pressed))
        self._pressed = pressed

    def _report(self, topics: _Topics, stamp: Time) -> None:
        battery = self._robot.battery
        topics.battery.publish(header={"stamp": stamp}, **battery_fields(battery))
        if topics.diagnostics.connections:
            level, text = battery_diagnosis(battery)
            bumped = (ERROR, "pressed") if self._pressed else (OK, "released")
            status = [
                self._status("battery", level, text),
                self._status("bumper", *bumped),
                self._drive_status(),
            ]
            topics.diagnostics.publish(header={"stamp": stamp}, status=status)

    def _drive_status(self) -> dict[str, Any]:
        age, limit = self._world.time - self._commanded_at, self._robot.model.drive.command_timeout
        if self._robot.battery.empty:
            return self._status("drive", ERROR, "off: the battery is empty")
        if math.isfinite(age) and age > limit:
            return self._status("drive", OK, f"stopped: no command for {age:.1f} s (limit {limit:g} s)")
        return self._status("drive", OK, "on")

    def _status(self, part: str, level: int, text: str) -> dict[str, Any]:
        return {
            "level": level,
            "name": f"{self._robot.id}: {part}",
            "message": text,
            "hardware_id": "simulated",
        }


_CONTROL_EVERY = 0.04
"""Seconds between two commands of the stand-in."""
