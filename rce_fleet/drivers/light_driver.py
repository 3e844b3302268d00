"""Light robots as ROS nodes: one node for many robots, each with its topics in its own namespace.

A light robot localizes and drives by itself. Below its namespace (``/Robot1``) the node publishes
``amcl_pose``, ``battery_state``, ``move_base/status`` and ``move_base/result``, and subscribes to
``move_base/goal``, ``move_base/cancel`` and ``speed_limit``. ``emergency_stop`` stops it until false releases
it, and ``raw_cmd_vel`` drives it by hand for half a second; it sees no obstacles then either. Poses come as
those of ``amcl`` do: after each ``update_min_d`` metres or ``update_min_a`` radians, and when the robot has
come to a stand.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import partial
from math import cos, pi, sin
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from rce.aio.tasks import run_in_groups
from rce.ros.types import Message, Time
from rce_fleet.drivers.fields import charge_fields
from rce_fleet.drivers.stand_in import status_of
from rce_fleet.navigation.navigation import read_speed_limit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rce.ros.node import Node, Publisher
    from rce_fleet.simulation.lidar import Floats
    from rce_fleet.simulation.light.robots import LightRobots
    from rce_fleet.simulation.noise import EstimateSpec

UPDATE_MIN_D = 0.25
"""Metres between two poses, as the default of ``amcl``."""
UPDATE_MIN_A = pi / 6
"""Radians between two poses, as the default of ``amcl``."""
STATUS_EVERY = 1.0
"""Seconds between two status lists of a robot, of simulated time or of the clock, whichever is sooner: the
fleet takes robots for silent after 3 s of the clock, also where the world runs slower."""
POSE_EVERY = 5.0
"""Seconds after which a standing robot sends its pose again, for those that came later."""
BATTERY_EVERY = 10.0
"""Seconds between two messages about a robot's battery."""
STANDS = 0.01
"""A slower robot stands, metres or radians per second."""
AT_ONCE = 100
"""Robots whose topics are registered side by side."""
POSE = "geometry_msgs/PoseWithCovarianceStamped"
_HEAD = struct.Struct("<III")
_FRAME = b"map"
_BODY = struct.Struct("<7d")


@dataclass(slots=True)
class _Topics:
    """The publishers of one robot."""

    pose: Publisher
    status: Publisher
    result: Publisher
    battery: Publisher


class LightDriver:
    """Runs light robots of a world as one node.

    Args:
        node: Running node.
        robots: All light robots of the world.
        rows: Rows of those that this node runs.
        now: Returns the time for stamps.
    """

    def __init__(
        self, node: Node, robots: LightRobots, rows: Sequence[int], now: Callable[[], Time] = Time.now
    ) -> None:
        self._node = node
        self._robots = robots
        self._rows = np.array(rows, np.int64)
        self._now = now
        self._topics: dict[int, _Topics] = {}
        self._covariance = _covariance(robots.bodies.model.estimate)
        self.reset()

    async def start(self) -> None:
        """Create publishers and subscribers. They end with the node."""
        await run_in_groups([partial(self._start, row) for row in self._rows.tolist()], AT_ONCE)

    async def _start(self, row: int) -> None:
        node, name = self._node, f"/{self._robots.names[row]}"
        await node.subscribe(
            f"{name}/move_base/goal", "move_base_msgs/MoveBaseActionGoal", self._on_goal(row)
        )
        await node.subscribe(f"{name}/move_base/cancel", "actionlib_msgs/GoalID", self._on_cancel(row))
        await node.subscribe(f"{name}/emergency_stop", "std_msgs/Bool", self._on_stop(row))
        await node.subscribe(f"{name}/raw_cmd_vel", "geometry_msgs/Twist", self._on_velocity(row))
        await node.subscribe(f"{name}/speed_limit", "std_msgs/Float64", self._on_speed_limit(row))
        result = await node.advertise(f"{name}/move_base/result", "move_base_msgs/MoveBaseActionResult")
        status = await node.advertise(f"{name}/move_base/status", "actionlib_msgs/GoalStatusArray")
        battery = await node.advertise(f"{name}/battery_state", "sensor_msgs/BatteryState")
        pose = await node.advertise(f"{name}/amcl_pose", POSE)
        self._topics[row] = _Topics(pose, status, result, battery)

    def reset(self) -> None:
        """Begin anew with the world's time."""
        count = len(self._rows)
        self._shown: Floats = np.full((count, 3), np.inf)
        self._moved: NDArray[np.bool_] = np.ones(count, np.bool_)
        self._shown_at: Floats = np.full(count, -np.inf)
        # Spread over time: not all robots send in the same step.
        spread = np.linspace(0.0, BATTERY_EVERY, count, endpoint=False)
        self._measured_at: Floats = self._robots.time - spread
        spread = np.linspace(0.0, STATUS_EVERY, count, endpoint=False)
        self._listed_at: Floats = self._robots.time - spread
        self._listed_by_clock: Floats = monotonic() - spread

    def update(self, ended: Sequence[int]) -> None:
        """Publish what is due; call it after a step of the world.

        Args:
            ended: Rows of robots with goals that ended, as :meth:`LightRobots.take_ended` returned them.
        """
        if not self._topics:
            return
        now, stamp = self._robots.time, self._now()
        present = self._robots.present
        for row in ended:
            if row in self._topics and present[row]:
                self._publish_results(row, stamp)
        self._publish_poses(now, stamp)
        clock, least = monotonic(), STATUS_EVERY - 1e-6
        due = np.flatnonzero((now - self._listed_at >= least) | (clock - self._listed_by_clock >= least))
        self._listed_at[due], self._listed_by_clock[due] = now, clock
        for row in self._present(due):
            self._publish_status(row, stamp)
        due = np.flatnonzero(now - self._measured_at >= BATTERY_EVERY - 1e-6)
        self._measured_at[due] = now
        for row in self._present(due):
            self._publish_battery(row, stamp)

    def _present(self, due: NDArray[np.int64]) -> list[int]:
        """Return the rows of robots that are due, without those that were removed: these are silent."""
        rows = self._rows[due]
        found: list[int] = rows[self._robots.present[rows]].tolist()
        return found

    def _publish_battery(self, row: int, stamp: Time) -> None:
        batteries, topic = self._robots.batteries, self._topics[row].battery
        if topic.connections:
            share, power = float(batteries.shares[row]), float(batteries.power[row])
            charging = bool(batteries.charging[row])
            topic.publish(
                header={"stamp": stamp}, **charge_fields(batteries.spec, share, power, charging=charging)
            )

    def _publish_results(self, row: int, stamp: Time) -> None:
        topics, goals = self._topics[row], self._robots.goal_lists[row]
        for goal in goals.take_ended():
            topics.result.publish(header={"stamp": stamp}, status=status_of(goal), result={})
        self._publish_status(row, stamp)

    def _publish_status(self, row: int, stamp: Time) -> None:
        goals = self._robots.goal_lists[row]
        goals.now = self._robots.time
        goals.forget()
        self._topics[row].status.publish(
            header={"stamp": stamp}, status_list=[status_of(goal) for goal in goals.goals]
        )

    def _publish_poses(self, now: float, stamp: Time) -> None:
        """Publish the poses of robots that moved far enough, came to a stand, or were silent for long."""
        bodies = self._robots.bodies
        poses, speeds = bodies.estimates[self._rows], bodies.speeds[self._rows]
        moving: NDArray[np.bool_] = np.abs(speeds).max(axis=1) > STANDS
        away = poses - self._shown
        far = (np.hypot(away[:, 0], away[:, 1]) >= UPDATE_MIN_D) | (np.abs(away[:, 2]) >= UPDATE_MIN_A)
        stopped = self._moved & ~moving
        due = np.flatnonzero(
            ((moving & far) | stopped | (now - self._shown_at >= POSE_EVERY))
            & self._robots.present[self._rows]
        )
        self._moved = moving
        self._shown[due], self._shown_at[due] = poses[due], now
        for row, (x, y, yaw) in zip(self._rows[due].tolist(), poses[due].tolist(), strict=True):
            topic = self._topics[row].pose
            if topic.connections:
                topic.publish_serialized(self._serialized(stamp, x, y, yaw))

    def _serialized(self, stamp: Time, x: float, y: float, yaw: float) -> bytes:
        """Return a ``geometry_msgs/PoseWithCovarianceStamped`` as it is on the wire."""
        head = _HEAD.pack(0, stamp.secs, stamp.nsecs) + len(_FRAME).to_bytes(4, "little") + _FRAME
        return head + _BODY.pack(x, y, 0.0, 0.0, 0.0, sin(yaw / 2), cos(yaw / 2)) + self._covariance

    def _on_goal(self, row: int) -> Callable[[Message], None]:
        def take(message: Message) -> None:
            place, goal_id = message.goal.target_pose.pose.position, message.goal_id
            self._robots.accept(row, goal_id.id, goal_id.stamp.to_sec(), place.x, place.y)

        return take

    def _on_cancel(self, row: int) -> Callable[[Message], None]:
        def take(message: Message) -> None:
            self._robots.cancel(row, message.id, message.stamp.to_sec())

        return take

    def _on_stop(self, row: int) -> Callable[[Message], None]:
        return lambda message: self._robots.stop(row, stopped=message.data)

    def _on_velocity(self, row: int) -> Callable[[Message], None]:
        return lambda message: self._robots.drive(row, message.linear.x, message.angular.z)

    def _on_speed_limit(self, row: int) -> Callable[[Message], None]:
        def take(message: Message) -> None:
            try:
                self._robots.limit_speed(row, read_speed_limit(message.data))
            except ValueError as error:
                self._node.log.warning("%s: %s", self._robots.names[row], error)

        return take


def _covariance(spec: EstimateSpec) -> bytes:
    """Return the 6 x 6 matrix of ``geometry_msgs/PoseWithCovariance`` as it is on the wire."""
    matrix = np.zeros((6, 6))
    matrix[[0, 1, 5], [0, 1, 5]] = spec.position**2, spec.position**2, spec.heading**2
    return matrix.astype("<f8").tobytes()
