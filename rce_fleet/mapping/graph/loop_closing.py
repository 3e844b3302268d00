"""Loop closing: keyscans that may be near each other are matched, and matches that may be false are refused.

A match is refused if its score is too low, if too few points lie on the other scans' lines, if one side saw
through what the other side reports, or if another place in the window fits nearly as well (symmetric places).
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import relative, transform_points
from rce_fleet.mapping.graph.alignment import align
from rce_fleet.mapping.graph.correlative import Window, find_match
from rce_fleet.mapping.graph.front_end import Submap, make_submap
from rce_fleet.mapping.graph.visibility import conflict_share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.graph.parameters import GraphParameters
    from rce_fleet.mapping.graph.scan_points import ScanPoints

LEVELS = 7
"""Levels of the pyramids; the top one has 64 cells, 3.2 m."""
TURN_STEP = 0.015
CACHE = 64
"""So many submaps are kept."""
PRIOR_WEIGHT = 0.02
APART = (0.5, 0.3)
"""Places at least this far apart are different, metres and radians."""
MOST_CANDIDATES = 2
CHAIN_WAY = 3.5
"""The scans around a keyscan reach this far along the way, metres..."""
CHAIN_KEYS = 12
"""... and are at most so many to each side."""
VIEW_STEP = 3
"""Of the scans around the earlier one, each so many are asked whether they saw through."""


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """A verified match of two keyscans.

    Attributes:
        earlier: Number of the keyscan that it was matched to.
        later: Number of the keyscan that was matched.
        pose: Pose of the later one in the frame of the earlier one, shape (3,).
        information: Its inverse covariance, shape (3, 3).
        length: Way in the graph between both without this closure, metres; ``inf`` if none joins them.
        score: Score of the match, 0 to 1.
    """

    earlier: int
    later: int
    pose: NDArray[np.float64]
    information: NDArray[np.float64]
    length: float
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where a scan fits.

    Attributes:
        pose: Its pose in the frame of a keyscan, shape (3,).
        information: Inverse covariance of the pose, shape (3, 3).
        score: Score of the match, 0 to 1.
    """

    pose: NDArray[np.float64]
    information: NDArray[np.float64]
    score: float


class LoopMatcher:
    """Finds and verifies closures.

    Attributes:
        refused: How many matches were refused, by reason.
    """

    def __init__(self, graph: KeyGraph, parameters: GraphParameters) -> None:
        self._graph = graph
        self._parameters = parameters
        self._submaps: OrderedDict[int, tuple[int, Submap, list[int]]] = OrderedDict()
        self.refused = {"score": 0, "points": 0, "conflict": 0, "rival": 0}

    def forget(self) -> None:
        """Make all submaps anew: keyscans were removed."""
        self._submaps.clear()

    def candidates(self, key: int, lengths: NDArray[np.float64]) -> list[int]:
        """Return earlier keyscans of the same part that a keyscan may be near to, the nearest first.

        Args:
            key: Number of the keyscan.
            lengths: Way in the graph to each keyscan, metres, shape (N,).
        """
        graph, parameters = self._graph, self._parameters
        apart = np.hypot(*(graph.poses[:key, :2] - graph.poses[key, :2]).T)
        drift = np.minimum(parameters.loop_drift * lengths[:key], parameters.loop_reach)
        other = np.array(graph.robots[:key]) != graph.robots[key]
        left = graph.ways[key] - np.array(graph.ways[:key]) > parameters.loop_way
        possible = (apart < parameters.loop_distance + drift) & (other | left) & np.isfinite(lengths[:key])
        chosen: list[int] = []
        for near in np.flatnonzero(possible)[np.argsort(apart[possible])].tolist():
            if not any(self._is_same_place(near, one) for one in chosen):
                chosen.append(near)
                if len(chosen) == MOST_CANDIDATES:
                    break
        return chosen

    def _is_same_place(self, one: int, two: int) -> bool:
        graph = self._graph
        return (
            graph.robots[one] == graph.robots[two] and abs(graph.ways[one] - graph.ways[two]) < 2 * CHAIN_WAY
        )

    def window(self, length: float) -> tuple[float, float]:
        """Return how far a closure may be from the current estimate after this way: metres, radians."""
        parameters = self._parameters
        return (
            min(0.3 + parameters.loop_drift * length, parameters.loop_reach),
            min(0.1 + 0.003 * length, np.pi),
        )

    def match(self, earlier: int, later: int, length: float) -> Closure | None:
        """Return the closure of two keyscans of one part, or None where they do not match beyond doubt.

        Args:
            earlier: Number of the keyscan that is matched to.
            later: Number of the keyscan that is matched.
            length: Way in the graph between them, metres.
        """
        poses = self._graph.poses
        expected = relative(poses[earlier], poses[later])
        fit = self.fit(earlier, self._graph.scans[later], expected, self.window(length), PRIOR_WEIGHT)
        return None if fit is None else Closure(earlier, later, fit.pose, fit.information, length, fit.score)

    def match_anywhere(self, earlier: int, later: int) -> Closure | None:
        """Return the closure of two keyscans of different parts: any heading, up to a few metres apart."""
        fit = self.fit_anywhere(earlier, self._graph.scans[later])
        return None if fit is None else Closure(earlier, later, fit.pose, fit.information, np.inf, fit.score)

    def fit_anywhere(self, key: int, scan: ScanPoints) -> Fit | None:
        """Return where a scan fits around a keyscan: any heading, up to a few metres away."""
        return self.fit(key, scan, np.zeros(3), (self._parameters.loop_distance, np.pi), 0.0)

    def fit(
        self,
        key: int,
        scan: ScanPoints,
        expected: NDArray[np.float64],
        reaches: tuple[float, float],
        prior_weight: float,
    ) -> Fit | None:
        """Return where a scan fits to the scans around a keyscan, or None where it does not beyond doubt.

        Args:
            key: Number of the keyscan.
            scan: The scan.
            expected: Expected pose in the frame of the keyscan, shape (3,).
            reaches: How far from it the scan may be, metres and radians.
            prior_weight: See :class:`~rce_fleet.mapping.graph.correlative.Window`.
        """
        parameters = self._parameters
        if len(scan) < parameters.fewest_points:
            return None
        submap, members = self._submap(key)
        window = Window(*reaches, TURN_STEP, prior_weight)
        match = find_match(submap.field, scan.points, expected, window, at_least=parameters.loop_score)
        if match is None:
            self.refused["score"] += 1
            return None
        aligned = align(scan, submap.reference, match.pose)
        moved = np.abs(aligned.pose - match.pose)
        if aligned.inliers < parameters.loop_inliers or moved[:2].max() > APART[0]:
            self.refused["points"] += 1
            return None
        if self._conflict(key, scan, aligned.pose, members) > parameters.loop_conflicts:
            self.refused["conflict"] += 1
            return None
        if reaches[0] > APART[0] or reaches[1] > APART[1]:
            least = parameters.loop_rival * match.score
            rival = find_match(
                submap.field,
                scan.points,
                expected,
                window,
                other_than=match.pose,
                apart=APART,
                at_least=least,
            )
            if rival is not None:
                self.refused["rival"] += 1
                return None
        return Fit(aligned.pose, aligned.information, match.score)

    def _conflict(self, key: int, scan: ScanPoints, pose: NDArray[np.float64], members: list[int]) -> float:
        """Return the greater share of points that one side of a match saw through on the other side."""
        graph = self._graph
        base = graph.poses[key]
        views = [
            (graph.scans[member], relative(base, graph.poses[member])) for member in members[::VIEW_STEP]
        ]
        forth = conflict_share(transform_points(pose, scan.points), views)
        back = conflict_share(graph.scans[key].points, [(scan, pose)])
        return max(forth, back)

    def _submap(self, key: int) -> tuple[Submap, list[int]]:
        """Return the scans around a keyscan, in its frame."""
        cached = self._submaps.get(key)
        if cached is not None and cached[0] == self._graph.moves:
            self._submaps.move_to_end(key)
            return cached[1], cached[2]
        members = chain(self._graph, key)
        poses = relative(self._graph.poses[key], self._graph.poses[members])
        submap = make_submap(
            [self._graph.scans[member] for member in members], poses, self._parameters, levels=LEVELS
        )
        self._submaps[key] = self._graph.moves, submap, members
        if len(self._submaps) > CACHE:
            self._submaps.popitem(last=False)
        return submap, members


def chain(graph: KeyGraph, key: int) -> list[int]:
    """Return the keyscans of the same robot a few metres before and after a keyscan, ascending."""
    keys, place = graph.keys_of(graph.robots[key]), graph.place_of(key)
    members = [key]
    for step in (-1, 1):
        at = place + step
        while 0 <= at < len(keys) and abs(at - place) <= CHAIN_KEYS:
            if (
                abs(graph.ways[keys[at]] - graph.ways[key]) > CHAIN_WAY
                or graph.parts[keys[at]] != graph.parts[key]
            ):
                break
            members.append(keys[at])
            at += step
    return sorted(members)
