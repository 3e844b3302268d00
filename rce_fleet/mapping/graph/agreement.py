"""Agreement of loops: one over a long way, or between two robots, waits until others agree with it."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, isfinite
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.graph.joining import part_conflict

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.graph.loop_closing import Closure
    from rce_fleet.mapping.graph.parameters import GraphParameters

SHIFT = 0.15
"""Two closures agree if the way around both ends within this of its start, metres, plus the expected
drift..."""
TURN = 0.04
"""... and within this, radians."""
TURN_DRIFT = 0.003
MOST_WAY = 30.0
"""Closures farther apart than this, metres, say nothing of each other."""
MOST_PENDING = 200
NEAR = 1.0
"""For ways this short the graph is not searched, metres."""


class Agreement:
    """Holds closures back until enough of them agree.

    Args:
        graph: The graph.
        parameters: Parameters.
    """

    def __init__(self, graph: KeyGraph, parameters: GraphParameters) -> None:
        self._graph = graph
        self._parameters = parameters
        self.pending: list[Closure] = []

    def add(self, closure: Closure) -> list[Closure]:
        """Take a closure, and return those that are accepted now: none, or a group that agrees."""
        parameters = self._parameters
        if closure.length < parameters.loop_alone:
            return [closure]
        if not isfinite(closure.length):
            return self._add_joining(closure)
        group = self._group_of(closure)
        self.pending.append(closure)
        if len(group) < parameters.loop_group or self._spread(group) < parameters.loop_spread:
            return []
        self.pending = [other for other in self.pending if other not in group]
        return group

    def _add_joining(self, closure: Closure) -> list[Closure]:
        """Take a closure between two parts, and return the group that joins them now, or nothing.

        Parts are joined by more closures, over a longer way, than a loop takes, as nothing else tells where
        the parts are. What disagrees must be rare, and the parts must not see through each other's walls.
        """
        parameters = self._parameters
        self._forget()
        if part_conflict(self._graph, closure) > parameters.join_conflicts:
            return []
        group = self._group_of(closure)
        self.pending.append(closure)
        if len(group) < parameters.join_group or self._spread(group) < parameters.join_spread:
            return []
        # What was found when less of the parts was known may not fit any more.
        self.pending = [
            one
            for one in self.pending
            if isfinite(one.length) or part_conflict(self._graph, one) <= parameters.join_conflicts
        ]
        others = [
            one for one in self.pending if one not in group and self._is_between_same_parts(one, closure)
        ]
        if len(others) > parameters.join_disagreement * len(group):
            return []
        self.pending = [other for other in self.pending if other not in group]
        return group

    def _is_between_same_parts(self, one: Closure, two: Closure) -> bool:
        parts = self._graph.parts
        return {int(parts[one.earlier]), int(parts[one.later])} == {
            int(parts[two.earlier]),
            int(parts[two.later]),
        }

    def _group_of(self, closure: Closure) -> list[Closure]:
        """Return the closure and pending ones of which each agrees with all others."""
        group = [closure]
        for other in reversed(self.pending):
            if all(self._agree(other, member) for member in group):
                group.append(other)
        return group

    def _forget(self) -> None:
        """Drop closures between keyscans that other closures have joined, and the oldest of too many."""
        parts = self._graph.parts
        self.pending = [
            one
            for one in self.pending[-MOST_PENDING:]
            if isfinite(one.length) or parts[one.earlier] != parts[one.later]
        ]

    def renumber(self, numbers: NDArray[np.int64]) -> None:
        """Take the new numbers of the keyscans, shape (N,), after others were removed; -1: removed."""
        self.pending = [
            replace(one, earlier=int(numbers[one.earlier]), later=int(numbers[one.later]))
            for one in self.pending
            if min(numbers[one.earlier], numbers[one.later]) >= 0
        ]

    def _spread(self, group: list[Closure]) -> float:
        """Return the longest way of one robot between the later keyscans of a group, metres."""
        graph = self._graph
        ways: dict[int, list[float]] = {}
        for one in group:
            ways.setdefault(graph.robots[one.later], []).append(graph.ways[one.later])
        return max(max(each) - min(each) for each in ways.values())

    def _agree(self, one: Closure, two: Closure) -> bool:
        """Return whether the way around two closures returns to its start.

        After Olson 2009, "Recognizing places using spectrally clustered local matches", and Mangelson et
        al. 2018, "Pairwise consistent measurement set maximization".
        """
        graph, poses = self._graph, self._graph.poses
        if isfinite(one.length) != isfinite(two.length):
            return False
        way = self._way(one.later, two.later) + self._way(one.earlier, two.earlier)
        if way > MOST_WAY or graph.parts[one.earlier] != graph.parts[two.earlier]:
            return False
        direct = compose(one.pose, relative(poses[one.later], poses[two.later]))
        around = compose(relative(poses[one.earlier], poses[two.earlier]), two.pose)
        error = relative(direct, around)
        return bool(
            hypot(error[0], error[1]) < SHIFT + self._parameters.loop_drift * way
            and np.abs(error[2]) < TURN + TURN_DRIFT * way
        )

    def _way(self, one: int, two: int) -> float:
        graph = self._graph
        apart = abs(graph.ways[one] - graph.ways[two])
        if graph.robots[one] == graph.robots[two] and apart < NEAR:
            return apart
        lengths = graph.lengths_from(one, limit=MOST_WAY)
        return float(lengths[two]) if isfinite(lengths[two]) else inf
