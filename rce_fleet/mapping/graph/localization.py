"""Localization in a saved graph map: scans are matched to the keyscans nearby, and the map stays as it is."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose, compose, relative
from rce_fleet.mapping.graph.front_end import Submap, make_submap, place_scan
from rce_fleet.mapping.graph.joining import PlaceList
from rce_fleet.mapping.graph.loop_closing import APART, LoopMatcher
from rce_fleet.mapping.graph.parameters import GraphParameters
from rce_fleet.mapping.graph.scan_points import ScanPoints, prepare_scan
from rce_fleet.mapping.graph.tracker import UNTRUSTED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.records import LaserRecord

LOST_AFTER = 20
"""After so many scans in a row without a match the robot is searched on the whole map."""
NEAREST_KEYS = 20
"""A scan is matched against so many keyscans."""
NEW_SUBMAP_WAY = 0.5
"""The submap is made anew after this way, metres."""


class GraphLocalizer:
    """Localizes one robot in a graph map.

    Args:
        graph: The map; its first part is used. It does not change.
        parameters: Parameters.
        start: First pose in the map, about, shape (3,); without it the robot is searched on the whole map.

    Attributes:
        pose: Pose in the map at the last scan, shape (3,); None while the robot is not found.
        unmatched: Number of scans in a row that did not match.
        jump: How the odometry jumped at the last scan; empty if it did not.
    """

    def __init__(
        self,
        graph: KeyGraph,
        parameters: GraphParameters | None = None,
        start: NDArray[np.float64] | None = None,
    ) -> None:
        self.pose = None if start is None else np.array(start, np.float64)
        self.unmatched = 0
        self.jump = ""
        self._watch = OdometryWatch()
        self._has_jumped = False
        self._graph = graph
        self._parameters = parameters or GraphParameters()
        self._matcher = LoopMatcher(graph, self._parameters)
        self._places = PlaceList(graph, self._parameters)
        self._keys = np.flatnonzero((graph.parts == 0) & (np.array([len(scan) for scan in graph.scans]) > 0))
        self._odometry: NDArray[np.float64] | None = None
        self._submap: Submap | None = None
        self._submap_at = np.zeros(3)

    def add(self, record: LaserRecord) -> NDArray[np.float64] | None:
        """Take the next scan and return the pose in the map, shape (3,); None while the robot is not found.

        Raises:
            ValueError: The odometry is not finite.
        """
        odometry = np.array(record.odometry, np.float64)
        if not np.isfinite(odometry).all():
            raise ValueError(
                f"scan {record.index}: the odometry must be three finite numbers, not {record.odometry}"
            )
        moved = np.zeros(3) if self._odometry is None else relative(self._odometry, odometry)
        self._odometry = odometry
        self.jump = self._watch.check(Pose(*record.odometry), record.time)
        if self.jump:
            moved, self._has_jumped = np.zeros(3), True
        scan = prepare_scan(record, farthest=self._parameters.usable_range, cell=self._parameters.point_cell)
        if self.pose is None or self.unmatched >= LOST_AFTER:
            found = self.find(scan)
            if found is not None:
                self.pose, self.unmatched, self._has_jumped = found, 0, False
                return self.pose
        if self.pose is None:
            return None
        scale = UNTRUSTED if self._has_jumped else 1.0
        submap = self._submap_near(self.pose)
        placement = place_scan(scan, submap, self.pose, moved, self._parameters, scale)
        self.unmatched = 0 if placement.is_matched else self.unmatched + 1
        self._has_jumped &= not placement.is_matched
        self.pose = placement.pose
        return self.pose

    def find(self, scan: ScanPoints) -> NDArray[np.float64] | None:
        """Return the pose of a scan anywhere on the map, or None if it fits nowhere, or at two places."""
        found: list[tuple[float, NDArray[np.float64]]] = []
        for place in self._places.all_of(0):
            fit = self._matcher.fit_anywhere(place, scan)
            if fit is not None:
                found.append((fit.score, compose(self._graph.poses[place], fit.pose)))
        if not found:
            return None
        score, best = max(found, key=lambda one: one[0])
        rivals = (pose for other, pose in found if other >= self._parameters.loop_rival * score)
        return None if any(_is_apart(pose, best) for pose in rivals) else best

    def _submap_near(self, pose: NDArray[np.float64]) -> Submap:
        """Return the nearest keyscans as a submap, in the map's frame."""
        shift = pose - self._submap_at
        if self._submap is None or hypot(shift[0], shift[1]) > NEW_SUBMAP_WAY:
            graph = self._graph
            apart = np.hypot(*(graph.poses[self._keys, :2] - pose[:2]).T)
            keys = self._keys[np.argsort(apart)[:NEAREST_KEYS]]
            self._submap = make_submap(
                [graph.scans[key] for key in keys], graph.poses[keys], self._parameters
            )
            self._submap_at = pose
        return self._submap


def _is_apart(one: NDArray[np.float64], two: NDArray[np.float64]) -> bool:
    return hypot(one[0] - two[0], one[1] - two[1]) > APART[0] or abs(wrap(float(one[2] - two[2]))) > APART[1]
