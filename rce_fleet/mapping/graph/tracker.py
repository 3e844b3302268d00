"""One robot's front end: places its scans one by one and makes keyscans of some of them."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose, compose, inverse, relative
from rce_fleet.mapping.graph.front_end import (
    Placement,
    Submap,
    in_frame_of,
    make_submap,
    odometry_information,
    odometry_sigmas,
    place_scan,
)
from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph
from rce_fleet.mapping.graph.scan_points import ScanPoints, prepare_scan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.parameters import GraphParameters
    from rce_fleet.mapping.records import LaserRecord

BLIND_WAY = 1.0
"""After this way without a match a scan becomes a keyscan by odometry alone, metres."""
BLIND_TURN = 1.0
"""The same for the turn, radians."""
LOST_SHIFT = 1.0
"""If odometry may err by more than this, metres, the robot is lost: the scan begins a part of its own."""
LOST_TURN = 1.0
"""The same for the heading, radians."""
GAP = 20.0
"""After so many seconds without a scan, and several usual pauses, a robot that moved is lost too..."""
GAP_PAUSES = 5.0
GAP_MOVE = 0.5
"""... if it moved by this, metres or radians. Odometry says where it is, not how far it went meanwhile."""
PAUSE_SHARE = 0.1
"""How fast the usual pause follows the pauses."""
CHANGED_BEAMS = 0.15
"""The robot has moved if more than this share of the beams has changed, whatever its odometry says..."""
CHANGE = (0.06, 0.03)
"""... by more than this, metres and share of the range."""
UNTRUSTED = 5.0
"""Odometry that says "still" then is trusted this much less than usual, and so is odometry that jumped."""
COAST = 1.0
"""For so long a robot whose odometry jumps is taken to move on, seconds."""
MATCHED_LENGTH = 0.01
"""What an edge adds to the way of the robot, metres."""
BLIND_LENGTH = 20.0
"""How much worse than a matched edge one by odometry alone is: factor of its way."""


class Tracker:
    """Places the scans of one robot.

    Attributes:
        robot: Number of the robot in the graph.
        key: Its newest keyscan; -1 before the first scan.
        offset: Where the robot is in the frame of this keyscan, shape (3,).
        way: Way so far, metres.
        matched: Number of scans that were matched.
        unmatched: Number of scans that did not match and were placed by odometry.
        scans: Number of scans.
        jumps: Number of jumps of the odometry.
        jump: How the odometry jumped at the last scan; empty if it did not.
        entries: Keyscan and offset of each scan, in the order in which they came; of the last one only
            without ``keeps_way``.

    Args:
        graph: The graph.
        parameters: Parameters.
        robot: Number of the robot in the graph.
        keeps_way: Keep where each scan was.
    """

    def __init__(
        self, graph: KeyGraph, parameters: GraphParameters, robot: int, *, keeps_way: bool = True
    ) -> None:
        self._graph = graph
        self._parameters = parameters
        self.robot = robot
        self.key = -1
        self.offset = np.zeros(3)
        self.way = 0.0
        self.matched = 0
        self.unmatched = 0
        self.scans = 0
        self.jumps = 0
        self.jump = ""
        self.entries: list[tuple[int, NDArray[np.float64]]] = []
        self._keeps_way = keeps_way
        self._watch = OdometryWatch()
        self._has_jumped = False
        self._odometry = np.zeros(3)
        self._newest = np.zeros(3), 0.0
        self._speed = np.zeros(3)
        self._ranges = np.zeros(0, np.float32)
        self._heard = 0.0
        self._pause = 0.0
        self._submap: Submap | None = None
        self._submap_of = (-1, -1)

    @property
    def pose(self) -> NDArray[np.float64]:
        """Where the robot is in the frame of its part of the graph, shape (3,)."""
        if not self.entries:
            return np.zeros(3)
        key, offset = self.entries[-1]
        return compose(self._graph.poses[key], offset)

    def add(self, record: LaserRecord, start: NDArray[np.float64] | None = None) -> int | None:
        """Place a scan.

        Args:
            record: The scan.
            start: Pose of the first scan; by default the origin.

        Returns:
            Number of the keyscan that it became, or None.
        """
        parameters = self._parameters
        odometry = np.array(record.odometry, np.float64)
        if self.key < 0:
            scan = prepare_scan(record, farthest=parameters.usable_range, cell=parameters.point_cell)
            self._odometry, self._ranges, self._heard = odometry, scan.ranges, record.time
            self._watch_odometry(record)
            self.key = self._graph.add(scan, np.zeros(3) if start is None else start, self.robot, 0.0)
            self._note(self.offset)
            return self.key
        is_gap = self._is_gap(record.time)
        self._watch_odometry(record)
        moved = relative(self._odometry, odometry)
        way, turn = hypot(moved[0], moved[1]), abs(float(moved[2]))
        is_still = way < parameters.still_distance and turn < parameters.still_turn
        if is_still and not self._has_changed(record):
            self._note(compose(self.offset, moved))
            return None
        scan = prepare_scan(record, farthest=parameters.usable_range, cell=parameters.point_cell)
        before = compose(self._graph.poses[self.key], self.offset)
        shift_error, turn_error = odometry_sigmas(moved, parameters)
        is_lost = is_gap and (max(way, turn) > GAP_MOVE or bool(self.jump))
        if is_lost or shift_error > LOST_SHIFT or turn_error > LOST_TURN:
            return self._begin_part(scan, compose(before, moved), odometry, way)
        sigma_scale = UNTRUSTED if is_still or self._has_jumped else 1.0
        placement = place_scan(scan, self._current_submap(), before, moved, parameters, sigma_scale)
        if not placement.is_matched:
            self.unmatched += 1
            if way < BLIND_WAY and turn < BLIND_TURN:
                # The odometry adds up until a scan matches, so its window grows.
                self._note(compose(self.offset, moved))
                return None
            if self._has_jumped:
                return self._begin_part(scan, compose(before, moved), odometry, way)
        else:
            self.matched += 1
            self._has_jumped = False
        self._odometry, self._ranges = odometry, scan.ranges
        return self._settle(scan, placement, before)

    def _watch_odometry(self, record: LaserRecord) -> None:
        """Notice odometry that jumps: the robot is taken to have moved on as before, and scans correct it."""
        odometry = np.array(record.odometry, np.float64)
        self.jump = self._watch.check(Pose(*record.odometry), record.time)
        before, then = self._newest
        pause = record.time - then
        if self.jump:
            self.jumps += 1
            self._has_jumped = True
            moved = compose(relative(self._odometry, before), min(max(pause, 0.0), COAST) * self._speed)
            self._odometry = compose(odometry, inverse(moved))
            self._speed = np.zeros(3)
        elif pause > 0:
            self._speed = relative(before, odometry) / pause
        self._newest = odometry, record.time

    def _note(self, offset: NDArray[np.float64]) -> None:
        """Note where a scan is in the frame of the newest keyscan."""
        self.scans += 1
        if not self._keeps_way:
            self.entries.clear()
        self.entries.append((self.key, offset))

    def renumber(self, numbers: NDArray[np.int64]) -> None:
        """Take the new numbers of the keyscans, shape (N,), after others were removed; -1: removed."""
        self.key = int(numbers[self.key])
        self.entries = [(int(numbers[key]), offset) for key, offset in self.entries]
        self._submap = None

    def _is_gap(self, time: float) -> bool:
        """Return whether scans before this one are missing."""
        pause, self._heard = time - self._heard, time
        if pause > GAP and pause > GAP_PAUSES * self._pause > 0:
            return True
        if pause > 0:
            self._pause += (PAUSE_SHARE if self._pause else 1.0) * (pause - self._pause)
        return False

    def _has_changed(self, record: LaserRecord) -> bool:
        """Return whether a scan differs so much from the last placed one that the robot has moved."""
        if len(record.ranges) != len(self._ranges):
            return True
        with np.errstate(invalid="ignore"):
            both = np.isfinite(record.ranges) & np.isfinite(self._ranges)
            changed = np.abs(record.ranges - self._ranges) > CHANGE[0] + CHANGE[1] * self._ranges
        return int(np.count_nonzero(changed & both)) > CHANGED_BEAMS * max(1, int(np.count_nonzero(both)))

    def _begin_part(
        self, scan: ScanPoints, pose: NDArray[np.float64], odometry: NDArray[np.float64], way: float
    ) -> int:
        """Make a scan the first keyscan of a part, which loops may join to the others; return its number."""
        self.unmatched += 1
        self.way += way
        self._has_jumped = False
        self._odometry, self._ranges = odometry, scan.ranges
        self.key, self.offset = self._graph.add(scan, pose, self.robot, self.way), np.zeros(3)
        self._note(self.offset)
        return self.key

    def _settle(self, scan: ScanPoints, placement: Placement, before: NDArray[np.float64]) -> int | None:
        """Take over a placement, and make the scan a keyscan if it is far enough from the last one."""
        parameters, graph = self._parameters, self._graph
        shift = relative(before, placement.pose)
        self.way += hypot(shift[0], shift[1])
        pose, information = in_frame_of(graph.poses[self.key], placement)
        self.offset = pose
        is_far = hypot(pose[0], pose[1]) >= parameters.key_distance or abs(pose[2]) >= parameters.key_turn
        is_rich = len(scan) >= parameters.fewest_points
        if not is_far or not (is_rich or not placement.is_matched):
            self._note(self.offset)
            return None
        length = self.way - graph.ways[self.key] + MATCHED_LENGTH
        if not placement.is_matched:
            information = odometry_information(pose, parameters)
            length *= BLIND_LENGTH
        key = graph.add(scan, placement.pose, self.robot, self.way)
        graph.join(Edge(self.key, key, pose, information, length))
        self.key, self.offset = key, np.zeros(3)
        self._note(self.offset)
        return key

    def _current_submap(self) -> Submap:
        """Return the newest keyscans of the robot as a submap, in the frame of its part."""
        graph = self._graph
        state = (self.key, graph.moves)
        if self._submap is None or self._submap_of != state:
            keys = graph.keys_of(self.robot)[-self._parameters.submap_keys :]
            keys = [key for key in keys if graph.parts[key] == graph.parts[self.key]]
            self._submap = make_submap(
                [graph.scans[key] for key in keys], graph.poses[keys], self._parameters
            )
            self._submap_of = state
        return self._submap
