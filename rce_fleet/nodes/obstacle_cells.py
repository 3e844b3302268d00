"""Reports cells of the fleet's grid that something on no map fills. Runs in a robot's namespace.

It subscribes to ``scan``, ``/tf``, ``map`` (the localization map), ``/fleet/map`` (one pixel is one cell)
and, where it is there, ``/fleet/state`` and ``/fleet/poses/RobotN``, so that it does not report other robots.
It publishes ``blockedCells`` and ``freedCells``. The work is done by
:mod:`rce_fleet.navigation.obstacle_cells`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from functools import partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce.ros.node import Message, Node, Publisher, run
from rce.ros.tf import ExtrapolationError, TransformError, TransformListener
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.observation import observe_scan
from rce_fleet.navigation.costmap.parameters import ObservationSource
from rce_fleet.navigation.obstacle_cells.watch import CellWatch, Findings, WatchParameters
from rce_fleet.navigation.scans import fault_of_scan, fault_of_stamp
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.grid_messages import GRID_TOPIC
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import angles_from_above, fault_of_map_frame, pose_of, read_map, read_pose
from rce_fleet.nodes.robot_place import full_name, named_in_message
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from numpy.typing import NDArray


CELLS = "std_msgs/Int32MultiArray"
REPEAT_EVERY = 1.0
"""Seconds after which cells are reported again while they are in sight: a message may be lost."""
FREED_FOR = 3.0
"""How long a freed cell is reported, seconds."""
POSES_LAST = 2.0
"""How long another robot's pose counts, seconds."""
QUIET = 3.0
"""Without a usable scan for so long the node's state is a warning, seconds."""
OLDEST = 2.0
"""Scans older than this are of no use, seconds."""


@dataclass(frozen=True, slots=True)
class ObstacleCellsParameters(WatchParameters):
    """Private parameters of the node.

    Attributes:
        map_frame: Frame of both maps.
        robot: This robot's name in the fleet; empty: the node's namespace.
        fleet_radius: Radius of the other robots, metres.
        static_map: Wait for the localization map: without it, walls and doors would be reported. If false,
            everything that is seen counts until a map comes.
    """

    map_frame: str = "map"
    robot: str = ""
    fleet_radius: float = 0.22
    static_map: bool = True


@dataclass(slots=True)
class _Others:
    """The other robots.

    Attributes:
        held: Cells that they hold.
        blocked: Cells that are blocked, as far as the fleet knows.
        poses: Their places by name, with the time of each.
    """

    held: frozenset[int] = frozenset()
    blocked: frozenset[int] = frozenset()
    poses: dict[str, tuple[float, Pose]] = field(default_factory=dict)


class ObstacleCellsNode:
    """Watches cells in a ROS graph.

    Args:
        node: Running node, in the robot's namespace.
        parameters: Of the watch.
    """

    def __init__(self, node: Node, parameters: ObstacleCellsParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._robot = parameters.robot or node.namespace.strip("/")
        self._throttled_log = ThrottledLog(node)
        self._watch: CellWatch | None = None
        self._fleet: OccupancyMap | None = None
        self._known: OccupancyMap | None = None
        self._others = _Others()
        self._reported: set[int] = set()
        self._freed: dict[int, float] = {}
        self._sent_at = float("-inf")
        self._used_at = -inf
        self._fault = ""
        """What was wrong with the last message that could not be used; empty once a scan was used."""
        self._waiting: deque[Message] = deque(maxlen=5)
        self._tf: TransformListener
        self._blocked_out: Publisher
        self._freed_out: Publisher

    async def run(self) -> None:
        """Watch until the node is stopped."""
        node = self._node
        self._blocked_out = await node.advertise("blockedCells", CELLS)
        self._freed_out = await node.advertise("freedCells", CELLS)
        diagnostics = await Diagnostics.start(node, "cells with obstacles")
        async with TransformListener(node, prefix="") as self._tf:
            await node.subscribe(GRID_TOPIC, "nav_msgs/OccupancyGrid", partial(self._take_map, fleet=True))
            await node.subscribe("map", "nav_msgs/OccupancyGrid", partial(self._take_map, fleet=False))
            await node.subscribe("/fleet/state", "fleet/FleetState", self._take_state)
            await node.subscribe("scan", "sensor_msgs/LaserScan", self._take_scan)
            while await node.sleep(1.0):
                level, text = self._state()
                if self._watch is None:
                    self._throttled_log.warn("waiting", text)
                cells = ", ".join(map(str, sorted(self._reported))) or "none"
                diagnostics.publish(level, text, {"blocked cells": cells})

    # What comes in

    def _take_map(self, message: Message, *, fleet: bool) -> None:
        try:
            picture = read_map(message)
        except ValueError as error:
            self._fault = f"a map on {GRID_TOPIC if fleet else self._node.resolve('map')} is ignored: {error}"
            self._throttled_log.warn("map", self._fault)
            return
        fault = fault_of_map_frame(message, full_name(self._tf, self._parameters.map_frame))
        if fault:
            self._throttled_log.warn("map frame", f"{GRID_TOPIC if fleet else 'the map'}: {fault}")
        if not fleet:
            self._known = picture
        elif self._fleet is not None and _same_place(self._fleet, picture):
            return  # Only cells were blocked or freed.
        else:
            self._fleet = picture
            self._reported.clear()
            self._freed.clear()
            self._others.held = self._others.blocked = frozenset()
        if self._fleet is not None and (self._known is not None or not self._parameters.static_map):
            self._watch = CellWatch(self._fleet, self._parameters, self._known)

    async def _take_state(self, message: Message) -> None:
        others = [robot for robot in message.robots if robot.id != self._robot]
        held = {cell for robot in others for cell in (robot.cell, *robot.granted) if cell >= 0}
        self._others.held = frozenset(held)
        self._others.blocked = frozenset({*message.blocked} - {*message.walls})
        for robot in others:
            if robot.id not in self._others.poses:
                self._others.poses[robot.id] = (float("-inf"), Pose(0.0, 0.0, 0.0))
                take = partial(self._take_pose, robot.id)
                topic = f"/fleet/poses/{robot.id}"
                await self._node.subscribe(topic, "geometry_msgs/PoseWithCovarianceStamped", take)

    def _take_pose(self, robot: str, message: Message) -> None:
        try:
            self._others.poses[robot] = (self._node.time(), read_pose(message.pose.pose))
        except ValueError as error:
            self._throttled_log.warn(f"pose of {robot}", f"the pose of {robot} is ignored: {error}")

    def _take_scan(self, message: Message) -> None:
        self._waiting.append(message)
        while self._waiting and self._use(self._waiting[0]):
            self._waiting.popleft()

    def _use(self, message: Message) -> bool:
        """Use a scan; return whether it need not wait for its transform any more."""
        watch, now = self._watch, self._node.time()
        if watch is None:
            return True
        angles = (message.angle_min, message.angle_max, message.angle_increment)
        limits = (message.range_min, message.range_max)
        stamp = message.header.stamp.to_sec()
        fault = fault_of_scan(len(message.ranges), angles, limits) or fault_of_stamp(stamp, now, OLDEST)
        if fault:
            self._fault = f"a scan is ignored: {fault}"
            self._throttled_log.warn("scan", self._fault)
            return True
        frame, when = named_in_message(message.header.frame_id), message.header.stamp
        try:
            found = self._tf.lookup(full_name(self._tf, self._parameters.map_frame), frame, when)
        except ExtrapolationError as error:
            self._fault = f"scans wait for their transform: {error}"
            return not error.is_future
        except TransformError as error:
            self._fault = f"scans wait for their transform: {error}"
            self._throttled_log.warn("tf", self._fault)
            return True
        reach = self._parameters.sight + 1.0
        source = ObservationSource(
            clearing=True, inf_is_valid=True, obstacle_range=reach, raytrace_range=reach
        )
        ranges = np.asarray(message.ranges, np.float64)
        ranges = np.where(ranges >= limits[1], np.inf, ranges)
        mounted = found.transform
        first, step = angles_from_above(mounted, angles[0], angles[2])
        seen = observe_scan(ranges, first, step, limits, pose_of(mounted), source, stamp)
        others = self._others
        suspects = others.blocked | self._reported
        findings = watch.take(seen, now, robots=self._places(now), held=others.held, suspects=suspects)
        self._report(findings, now)
        self._fault, self._used_at = "", now
        return True

    def _state(self) -> tuple[Level, str]:
        """Return level and text of the node's state."""
        age = self._node.time() - self._used_at
        if self._watch is None:
            return Level.WARN, self._fault or f"waiting for the map on {self._missing()}"
        if 0 <= age <= QUIET:
            return Level.OK, "watching"
        return Level.WARN, self._fault or ("no scan yet" if age == inf else f"no scan for {age:.0f} s")

    def _missing(self) -> str:
        """Return the name of the map that is missing."""
        return GRID_TOPIC if self._fleet is None else self._node.resolve("map")

    def _places(self, now: float) -> NDArray[np.float64]:
        """Return the other robots' places and radii, shape (K, 3)."""
        radius = self._parameters.fleet_radius
        fresh = [
            (pose.x, pose.y, radius)
            for seen_at, pose in self._others.poses.values()
            if 0 <= now - seen_at <= POSES_LAST
        ]
        return np.array(fresh, np.float64).reshape(-1, 3)

    # What goes out

    def _report(self, findings: Findings, now: float) -> None:
        """Publish what is new at once, and all that is in sight now and then."""
        fresh = set(findings.blocked) - self._reported
        freed = {cell for cell in findings.freed if cell not in self._freed}
        for cell in sorted(fresh):
            self._node.log.warning("cell %d is blocked by something that is on no map", cell)
        for cell in sorted(freed):
            self._node.log.info("cell %d is free again", cell)
            self._freed[cell] = now
        self._reported |= fresh
        self._reported -= set(findings.freed)
        repeats = not 0 <= now - self._sent_at < REPEAT_EVERY
        if not (fresh or freed or repeats):
            return
        self._sent_at = now
        for cell in findings.blocked:
            self._freed.pop(cell, None)
        if findings.blocked:
            self._blocked_out.publish(data=list(findings.blocked))
        if self._freed:
            self._freed_out.publish(data=sorted(self._freed))
        self._freed = {cell: at for cell, at in self._freed.items() if 0 <= now - at < FREED_FOR}


def _same_place(one: OccupancyMap, other: OccupancyMap) -> bool:
    return (one.rows, one.columns, one.resolution, one.origin) == (
        other.rows, other.columns, other.resolution, other.origin,
    )  # fmt: skip


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("obstacle_cells") as node:
        await ObstacleCellsNode(node, await read_parameters(node, ObstacleCellsParameters)).run()


if __name__ == "__main__":
    run(main())
