"""Keyscans of one or several robots, and the measured poses between them."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from rce_fleet.geometry.poses import compose, inverse
from rce_fleet.mapping.graph.pose_graph import Edges, edge_errors, optimize

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.scan_points import ScanPoints

ROBUST = 3.0
"""Scale of the robust weight of edges that may be wrong, standard deviations."""
FIRST_CAPACITY = 64


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured pose of keyscan ``second`` in the frame of keyscan ``first``.

    Attributes:
        first: Number of the keyscan that it was measured from.
        second: Number of the keyscan that was measured.
        pose: (x, y, yaw), shape (3,).
        information: Inverse covariance, shape (3, 3).
        length: Way of a robot that drifts as much as this edge may err, metres.
        is_loop: Whether it closes a loop; else it joins a robot's successive keyscans.
    """

    first: int
    second: int
    pose: NDArray[np.float64]
    information: NDArray[np.float64]
    length: float
    is_loop: bool = False


class KeyGraph:
    """Keyscans, their poses and edges.

    Keyscans that edges join are one *part* and share a frame; the first keyscan of a part keeps its pose. A
    part has the number of its first keyscan. Keyscans that edges other than loops join are one *strand*: the
    way of one robot without a gap. Loops join strands, and may be wrong.

    Attributes:
        scans: Points of the keyscans.
        robots: Number of the robot of each keyscan.
        ways: Way of its robot until each keyscan, metres.
        edges: Edges of front end and loop closing.
        refined: Edges of the last refinement, see :mod:`~rce_fleet.mapping.graph.refinement`.
        moves: Number of changes of poses: what was computed from poses is old when it has changed.
    """

    def __init__(self) -> None:
        self.scans: list[ScanPoints] = []
        self.robots: list[int] = []
        self.ways: list[float] = []
        self.edges: list[Edge] = []
        self.refined: list[Edge] = []
        self.moves = 0
        self._poses = np.zeros((FIRST_CAPACITY, 3))
        self._parts = np.zeros(FIRST_CAPACITY, np.int64)
        self._strands = np.zeros(FIRST_CAPACITY, np.int64)
        self._strand_count = 0
        self._ends = array("q")
        self._lengths = array("d")
        self._of_robot: dict[int, list[int]] = {}
        self._place: list[int] = []

    def __len__(self) -> int:
        return len(self.scans)

    @property
    def poses(self) -> NDArray[np.float64]:
        """Poses of the keyscans, each in the frame of its part, shape (N, 3); a view."""
        return self._poses[: len(self.scans)]

    @property
    def parts(self) -> NDArray[np.int64]:
        """Number of the part of each keyscan, shape (N,); a view."""
        return self._parts[: len(self.scans)]

    @property
    def strands(self) -> NDArray[np.int64]:
        """Number of the strand of each keyscan, shape (N,); a view. It stays when others are removed."""
        return self._strands[: len(self.scans)]

    @property
    def loops(self) -> int:
        """Number of edges that close loops."""
        return sum(edge.is_loop for edge in self.edges)

    def keys_of(self, robot: int) -> list[int]:
        """Return the keyscans of a robot, in the order of its way."""
        return self._of_robot.get(robot, [])

    def place_of(self, key: int) -> int:
        """Return the position of a keyscan in the list of its robot."""
        return self._place[key]

    def add(self, scan: ScanPoints, pose: NDArray[np.float64], robot: int, way: float) -> int:
        """Add a keyscan as a part of its own, and return its number."""
        number = len(self.scans)
        if number == len(self._poses):
            more = max(FIRST_CAPACITY, number)
            self._poses = np.concatenate((self._poses, np.zeros((more, 3))))
            self._parts = np.concatenate((self._parts, np.zeros(more, np.int64)))
            self._strands = np.concatenate((self._strands, np.zeros(more, np.int64)))
        self._poses[number] = pose
        self._parts[number] = number
        self._strands[number] = self._strand_count
        self._strand_count += 1
        self.scans.append(scan)
        self.robots.append(robot)
        self.ways.append(way)
        keys = self._of_robot.setdefault(robot, [])
        self._place.append(len(keys))
        keys.append(number)
        return number

    def join(self, edge: Edge) -> None:
        """Add an edge. If it joins two parts, the part with the greater number moves to the other's frame."""
        self.edges.append(edge)
        self._ends.extend((edge.first, edge.second))
        self._lengths.append(edge.length)
        if not edge.is_loop:
            ends = self.strands[[edge.first, edge.second]]
            self.strands[self.strands == ends.max()] = ends.min()
        one, two = int(self.parts[edge.first]), int(self.parts[edge.second])
        if one == two:
            return
        if one < two:
            moving, goal = edge.second, compose(self.poses[edge.first], edge.pose)
        else:
            moving, goal = edge.first, compose(self.poses[edge.second], inverse(edge.pose))
        members = self.parts == max(one, two)
        self.parts[members] = min(one, two)
        shift = compose(goal, inverse(self.poses[moving]))
        self.poses[members] = compose(shift, self.poses[members])
        if np.count_nonzero(members) > 1:
            self.moves += 1

    def keep(self, numbers: NDArray[np.int64], edges: Sequence[Edge]) -> None:
        """Remove keyscans, and give the others new numbers in the same order.

        Args:
            numbers: New number of each keyscan, -1 of those to remove, shape (N,); not of a part's first one.
            edges: The edges, with the new numbers.
        """
        kept = np.flatnonzero(numbers >= 0)
        poses, parts, strands = self.poses[kept], numbers[self.parts[kept]], self.strands[kept]
        self.scans = [self.scans[key] for key in kept]
        self.robots = [self.robots[key] for key in kept]
        self.ways = [self.ways[key] for key in kept]
        self._poses, self._parts, self._strands = poses, parts, strands
        self._of_robot, self._place = {}, []
        for number, robot in enumerate(self.robots):
            keys = self._of_robot.setdefault(robot, [])
            self._place.append(len(keys))
            keys.append(number)
        self.refined = [
            replace(edge, first=int(numbers[edge.first]), second=int(numbers[edge.second]))
            for edge in self.refined
            if min(numbers[edge.first], numbers[edge.second]) >= 0
        ]
        self._set_edges(list(edges))
        self.moves += 1

    def _set_edges(self, edges: list[Edge]) -> None:
        self.edges = edges
        self._ends = array("q", [end for edge in edges for end in (edge.first, edge.second)])
        self._lengths = array("d", [edge.length for edge in edges])

    def components(self, edges: Sequence[Edge]) -> NDArray[np.int64]:
        """Return the smallest number among the keyscans that edges join each one with, shape (N,)."""
        ends = np.array([(edge.first, edge.second) for edge in edges], np.int64).reshape(-1, 2)
        links = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(self), len(self)))
        _, labels = connected_components(links, directed=False)
        firsts = np.full(len(self), len(self), np.int64)
        np.minimum.at(firsts, labels, np.arange(len(self)))
        found: NDArray[np.int64] = firsts[labels]
        return found

    def part_at(self, dropped: Sequence[Edge]) -> None:
        """Remove edges; keyscans that nothing joins any more become parts of their own, where they are."""
        gone = {id(edge) for edge in dropped}
        self._set_edges([edge for edge in self.edges if id(edge) not in gone])
        self.refined = []
        self.parts[:] = self.components(self.edges)
        self.moves += 1

    def lengths_from(self, key: int, limit: float = inf) -> NDArray[np.float64]:
        """Return the length of the shortest way in the graph from a keyscan to each, metres, shape (N,)."""
        links = self._links(np.frombuffer(self._lengths) if self.edges else np.zeros(0))
        found: NDArray[np.float64] = dijkstra(links, directed=False, indices=key, limit=limit)
        return found

    def _links(self, values: NDArray[np.float64]) -> csr_matrix:
        ends = (
            np.frombuffer(self._ends, np.int64).reshape(-1, 2) if self.edges else np.zeros((0, 2), np.int64)
        )
        return csr_matrix((values, (ends[:, 0], ends[:, 1])), shape=(len(self), len(self)))

    def optimize(self, iterations: int = 10) -> None:
        """Move the keyscans to the poses that fit the edges best."""
        edges = [*self.edges, *self.refined]
        if edges:
            roots = self.parts == np.arange(len(self))
            self.poses[:] = optimize(self.poses, edge_arrays(edges), fixed=roots, iterations=iterations)
            self.moves += 1

    def drop_loops(self, shift: float, turn: float) -> list[Edge]:
        """Remove edges of loops that the poses contradict by more than this, metres and radians; return them.

        Loops that hold two robots together stay.
        """
        errors = edge_errors(self.poses, edge_arrays(self.edges))
        wrong = (np.hypot(errors[:, 0], errors[:, 1]) > shift) | (np.abs(errors[:, 2]) > turn)
        if not wrong.any():
            return []
        kept = [edge for edge, bad in zip(self.edges, wrong, strict=True) if not (bad and edge.is_loop)]
        dropped = [edge for edge, bad in zip(self.edges, wrong, strict=True) if bad and edge.is_loop]
        if len(np.unique(self.components(kept))) != len(np.unique(self.parts)):
            return []
        self._set_edges(kept)
        return dropped


def edge_arrays(edges: Sequence[Edge]) -> Edges:
    """Return edges as arrays."""
    return Edges(
        first=np.array([edge.first for edge in edges], np.int64),
        second=np.array([edge.second for edge in edges], np.int64),
        poses=np.array([edge.pose for edge in edges]).reshape(-1, 3),
        information=np.array([edge.information for edge in edges]).reshape(-1, 3, 3),
        robust=np.array([ROBUST if edge.is_loop else inf for edge in edges]),
    )
