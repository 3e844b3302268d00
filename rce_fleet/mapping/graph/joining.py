"""Joining of robots whose pose is not known: where on the map to look, and whether a find is true."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, inverse, relative, transform_points
from rce_fleet.mapping.graph.visibility import conflict_share

if TYPE_CHECKING:
    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.graph.loop_closing import Closure
    from rce_fleet.mapping.graph.parameters import GraphParameters

SPACING = 0.7
"""Places are this share of the loop distance apart, so that their windows overlap."""

MOST_SAMPLES = 40
"""So many keyscans of a part are compared with the other part."""
VIEW_RADIUS = 3.0
"""Keyscans nearer than this to each other are compared, metres."""
MOST_VIEWS = 4
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
        scan = graph.scans[int(here[at])]
        views = [(graph.scans[key], poses[key]) for key in near]
        forth = conflict_share(transform_points(moved[at], scan.points), views)
        back = conflict_share(
            transform_points(relative(moved[at], poses[near[0]]), graph.scans[near[0]].points),
            [(scan, np.zeros(3))],
        )
        shares.append(max(forth, back))
    if not shares:
        return 0.0
    worst = sorted(shares)[-max(1, round(WORST * len(shares))) :]
    return sum(worst) / len(worst)


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
