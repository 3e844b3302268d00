"""One robot's front end: places its scans one by one and makes keyscans of some of them."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.graph.front_end import (
    Placement,
    Submap,
    in_frame_of,
    make_submap,
    odometry_information,
    place_scan,
)
from rce_fleet.mapping.graph.key_graph import Edge
from rce_fleet.mapping.graph.scan_points import ScanPoints, prepare_scan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.graph.parameters import GraphParameters
    from rce_fleet.mapping.records import LaserRecord

BLIND_WAY = 1.0
"""After this way without a match a scan becomes a keyscan by odometry alone, metres."""
BLIND_TURN = 1.0
"""The same for the turn, radians."""
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
        entries: Keyscan and offset of each scan, in the order in which they came.
    """

    def __init__(self, graph: KeyGraph, parameters: GraphParameters, robot: int) -> None:
        self._graph = graph
        self._parameters = parameters
        self.robot = robot
        self.key = -1
        self.offset = np.zeros(3)
        self.way = 0.0
        self.matched = 0
        self.unmatched = 0
        self.entries: list[tuple[int, NDArray[np.float64]]] = []
        self._odometry = np.zeros(3)
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
            self._odometry = odometry
            self.key = self._graph.add(scan, np.zeros(3) if start is None else start, self.robot, 0.0)
            self.entries.append((self.key, self.offset))
            return self.key
        moved = relative(self._odometry, odometry)
        way, turn = hypot(moved[0], moved[1]), abs(float(moved[2]))
        if way < parameters.still_distance and turn < parameters.still_turn:
            self.entries.append((self.key, compose(self.offset, moved)))
            return None
        scan = prepare_scan(record, farthest=parameters.usable_range, cell=parameters.point_cell)
        before = compose(self._graph.poses[self.key], self.offset)
        placement = place_scan(scan, self._current_submap(), before, moved, parameters)
        if not placement.is_matched:
            self.unmatched += 1
            if way < BLIND_WAY and turn < BLIND_TURN:
                # The odometry adds up until a scan matches, so its window grows.
                self.entries.append((self.key, compose(self.offset, moved)))
                return None
        else:
            self.matched += 1
        self._odometry = odometry
        return self._settle(scan, placement, before)

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
            self.entries.append((self.key, self.offset))
            return None
        length = self.way - graph.ways[self.key] + MATCHED_LENGTH
        if not placement.is_matched:
            information = odometry_information(pose, parameters)
            length *= BLIND_LENGTH
        key = graph.add(scan, placement.pose, self.robot, self.way)
        graph.join(Edge(self.key, key, pose, information, length))
        self.key, self.offset = key, np.zeros(3)
        self.entries.append((self.key, self.offset))
        return key

    def _current_submap(self) -> Submap:
        """Return the newest keyscans of the robot as a submap, in the frame of its part."""
        graph = self._graph
        state = (self.key, graph.moves)
        if self._submap is None or self._submap_of != state:
            keys = graph.keys_of(self.robot)[-self._parameters.submap_keys :]
            self._submap = make_submap(
                [graph.scans[key] for key in keys], graph.poses[keys], self._parameters
            )
            self._submap_of = state
        return self._submap
