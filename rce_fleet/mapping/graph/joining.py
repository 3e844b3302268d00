"""Joining of robots whose pose is not known: where on the map to look, and whether a join is true."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, inverse, relative, transform_points
from rce_fleet.mapping.graph.visibility import conflict_share

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph
    from rce_fleet.mapping.graph.loop_closing import Closure
    from rce_fleet.mapping.graph.parameters import GraphParameters

SPACING = 0.7
"""Places are this share of the loop distance apart, so that their windows overlap."""

MOST_SAMPLES = 40
"""So many keyscans of a part are compared with the other part."""
VIEW_RADIUS = 3.0
"""Keyscans nearer than this to each other are compared, metres."""
MOST_VIEWS = 4
WATCHED, LEAST_WATCHED = 24, 8
"""Of two joined strands so many new keyscans where they overlap are watched, at least so many."""
WORST = 0.25
"""The share of the compared keyscans that counts: those that fit worst."""


def part_conflict(graph: KeyGraph, closure: Closure) -> float:
    """Return how badly two parts contradict each other if a closure joins them: 0 for not at all.

    This is the share of points seen through by the other part's scans, and the other way round, over the
    quarter of the compared keyscans that fit worst.
    """
    poses, parts = graph.poses, graph.parts
    shift = compose(compose(poses[closure.earlier], closure.pose), inverse(poses[closure.later]))
    there = np.flatnonzero(parts == parts[closure.earlier])
    here = np.flatnonzero(parts == parts[closure.later])
    moved = compose(shift, poses[here])
    shares = []
    for at in np.unique(np.linspace(0, len(here) - 1, MOST_SAMPLES).astype(np.int64)).tolist():
        apart = np.hypot(*(poses[there, :2] - moved[at, :2]).T)
        order = np.argsort(apart)[:MOST_VIEWS]
        near = there[order[apart[order] < VIEW_RADIUS]].tolist()
        if not near:
            continue
        shares.append(_conflict(graph, int(here[at]), moved[at], near))
    return _worst(shares) if shares else 0.0


def _conflict(graph: KeyGraph, key: int, pose: NDArray[np.float64], near: list[int]) -> float:
    """Return the share of points that a keyscan and others saw through, on the side where it is greater.

    Args:
        graph: The graph.
        key: The keyscan.
        pose: Its pose in the frame of the others, shape (3,).
        near: The others, the nearest first.
    """
    poses, scan = graph.poses, graph.scans[key]
    views = [(graph.scans[other], poses[other]) for other in near]
    forth = conflict_share(transform_points(pose, scan.points), views)
    back = conflict_share(
        transform_points(relative(pose, poses[near[0]]), graph.scans[near[0]].points), [(scan, np.zeros(3))]
    )
    return max(forth, back)


def _worst(shares: Collection[float]) -> float:
    """Return the mean of the greatest quarter."""
    worst = sorted(shares)[-max(1, round(WORST * len(shares))) :]
    return sum(worst) / len(worst)


class JoinWatch:
    """Watches whether later scans contradict the join of two strands of a part.

    Where strands overlap, a new keyscan of one must not see through the walls of the other, nor the other way
    round. A join that many keyscans contradict was wrong.

    Args:
        graph: The graph.
        parameters: Parameters.
    """

    def __init__(self, graph: KeyGraph, parameters: GraphParameters) -> None:
        self._graph = graph
        self._parameters = parameters
        self._shares: dict[tuple[int, int], deque[float]] = {}

    def add(self, key: int) -> list[Edge]:
        """Take a new keyscan; return the loops of a join that is contradicted now, or nothing."""
        graph = self._graph
        strand = int(graph.strands[key])
        others = np.flatnonzero((graph.parts == graph.parts[key]) & (graph.strands != strand))
        if not len(others) or len(graph.scans[key]) < self._parameters.fewest_points:
            return []
        apart = np.hypot(*(graph.poses[others, :2] - graph.poses[key, :2]).T)
        order = np.argsort(apart)
        near = others[order[apart[order] < VIEW_RADIUS]]
        for other in np.unique(graph.strands[near]).tolist():
            views = near[graph.strands[near] == other][:MOST_VIEWS].tolist()
            pair = (min(strand, other), max(strand, other))
            shares = self._shares.setdefault(pair, deque(maxlen=WATCHED))
            shares.append(_conflict(graph, key, graph.poses[key], views))
            if len(shares) >= LEAST_WATCHED and _worst(shares) > self._parameters.undo_conflicts:
                return self._undo(pair)
        return []

    def _undo(self, pair: tuple[int, int]) -> list[Edge]:
        """Return the loops that hold that strand of a pair which is tied to others less."""
        graph = self._graph
        strands = graph.strands
        self._shares = {other: shares for other, shares in self._shares.items() if not {*other} & {*pair}}
        loops = [edge for edge in graph.edges if strands[edge.first] != strands[edge.second]]
        first = int(strands[graph.parts[graph.strands == pair[0]][0]])
        tied = {
            strand: [edge for edge in loops if strand in (strands[edge.first], strands[edge.second])]
            for strand in pair
            if strand != first  # that of the part's first keyscan stays
        }
        others = {
            strand: sum({int(strands[edge.first]), int(strands[edge.second])} != {*pair} for edge in edges)
            for strand, edges in tied.items()
        }
        return tied[min(tied, key=lambda strand: (others[strand], -strand))]


class PlaceList:
    """Keyscans that cover the parts of a graph evenly.

    Each keyscan of a robot that is not joined is tried at a few places of the other parts; the next one at
    the next few.

    Args:
        graph: The graph.
        parameters: Parameters.
    """

    def __init__(self, graph: KeyGraph, parameters: GraphParameters) -> None:
        self._graph = graph
        self._parameters = parameters
        self._places: list[int] = []
        self._known = 0
        self._next = 0

    def update(self) -> None:
        """Make places of keyscans that are far from all places of their part."""
        graph, apart = self._graph, SPACING * self._parameters.loop_distance
        while self._known < len(graph):
            key = self._known
            self._known += 1
            if len(graph.scans[key]) < self._parameters.fewest_points:
                continue
            places = np.array(self._places, np.int64)
            places = places[graph.parts[places] == graph.parts[key]]
            shift = graph.poses[places, :2] - graph.poses[key, :2]
            if not len(places) or np.hypot(shift[:, 0], shift[:, 1]).min() > apart:
                self._places.append(key)

    def forget(self) -> None:
        """Choose all places anew: keyscans were removed."""
        self._places, self._known = [], 0

    def all_of(self, part: int) -> list[int]:
        """Return the places of a part."""
        self.update()
        return [place for place in self._places if self._graph.parts[place] == part]

    def of_other_parts(self, key: int) -> list[int]:
        """Return the next few places that a keyscan is tried at: earlier parts than its own."""
        parts = self._graph.parts
        part = int(parts[key])
        if part == 0:
            return []
        self.update()
        others = [place for place in self._places if parts[place] < part]
        count = min(self._parameters.join_places, len(others))
        chosen = [others[(self._next + step) % len(others)] for step in range(count)]
        self._next += count
        return chosen
