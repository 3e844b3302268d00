"""Judges contacts of many discs: exact distances of those pairs that a search tree or a raster finds near."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.simulation.lidar import Floats
from rce_fleet.simulation.walls import distances

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.simulation.walls import Block

    Numbers = NDArray[np.int64]

RASTER = 1.0
"""Edge of a bin of the raster of edges, metres."""


class EdgeRaster:
    """Finds the edges near points.

    Args:
        edges: Edges of solid things, shape (M, 4): x, y of both ends, metres.
        reach: How near an edge must be to be found, metres.
    """

    def __init__(self, edges: Floats, reach: float) -> None:
        self._edges = edges
        ends = edges.reshape(-1, 2, 2)
        low, high = ends.min(axis=1) - reach, ends.max(axis=1) + reach
        self._corner = low.min(axis=0) if len(edges) else np.zeros(2)
        first = ((low - self._corner) // RASTER).astype(np.int64)
        last = ((high - self._corner) // RASTER).astype(np.int64)
        self._size = last.max(axis=0) + 1 if len(edges) else np.zeros(2, np.int64)
        spans = last - first + 1
        counts = spans[:, 0] * spans[:, 1]
        owners = np.repeat(np.arange(len(edges)), counts)
        inner = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
        columns = first[owners, 0] + inner % spans[owners, 0]
        rows = first[owners, 1] + inner // spans[owners, 0]
        bins = rows * self._size[0] + columns
        order = np.argsort(bins, kind="stable")
        self._owners: Numbers = owners[order]
        self._starts: Numbers = np.searchsorted(bins[order], np.arange(int(self._size.prod()) + 1))

    def touching(self, places: Floats, radii: Floats) -> tuple[Numbers, Numbers]:
        """Return the pairs of a disc and an edge that it overlaps.

        Args:
            places: Middles of the discs, shape (N, 2), metres.
            radii: Their radii, shape (N,), metres; none larger than the raster's reach.

        Returns:
            Numbers of discs and of edges, both of shape (P,).
        """
        at = ((places - self._corner) // RASTER).astype(np.int64)
        inside = ((at >= 0) & (at < self._size)).all(axis=1)
        discs = np.flatnonzero(inside)
        bins = at[discs, 1] * self._size[0] + at[discs, 0]
        begins, counts = self._starts[bins], self._starts[bins + 1] - self._starts[bins]
        owners = np.repeat(discs, counts)
        inner = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
        edges = self._owners[np.repeat(begins, counts) + inner]
        near = _distances(places[owners], self._edges[edges]) < radii[owners]
        return owners[near], edges[near]


class ContactJudge:
    """Counts contacts; each counts once, when it begins.

    Args:
        edges: Edges of solid things, shape (M, 4), metres.
        is_wall: Which edges belong to walls and not to boxes, shape (M,).
        reach: The largest radius of a disc, metres.

    Attributes:
        with_robots: Contacts between two discs.
        with_walls: Contacts between a disc and a wall.
        with_boxes: Contacts between a disc and a box.
        with_walkers: Contacts between a disc and a walker.
        with_doors: Contacts between a disc and a door.
        min_separation: Smallest distance between the hulls of two discs so far, metres.
        began: Pairs of discs whose contact began with the last update.
    """

    def __init__(self, edges: Floats, is_wall: NDArray[np.bool_], reach: float) -> None:
        self.with_robots = self.with_walls = self.with_boxes = 0
        self.with_walkers = self.with_doors = 0
        self.min_separation = inf
        self.began: set[tuple[int, int]] = set()
        self._pairs: set[tuple[int, int]] = set()
        self._at_walls: set[int] = set()
        self._at_boxes: set[int] = set()
        self._at_walkers: set[tuple[int, int]] = set()
        self._at_doors: set[tuple[int, int]] = set()
        self._reach = reach
        self.set_edges(edges, is_wall)

    def set_edges(self, edges: Floats, is_wall: NDArray[np.bool_]) -> None:
        """Take other edges; as for the constructor."""
        self._raster, self._is_wall = EdgeRaster(edges, self._reach), is_wall

    def leave_out(self, disc: int) -> None:
        """Leave a disc out from the next update on: the numbers of those after it are one less then."""

        def moved(numbers: set[int]) -> set[int]:
            return {number - (number > disc) for number in numbers - {disc}}

        def moved_first(pairs: set[tuple[int, int]]) -> set[tuple[int, int]]:
            return {(first - (first > disc), other) for first, other in pairs if first != disc}

        pairs = {(first, second - (second > disc)) for first, second in self._pairs if second != disc}
        self._pairs = moved_first(pairs)
        self._at_walls, self._at_boxes = moved(self._at_walls), moved(self._at_boxes)
        self._at_walkers, self._at_doors = moved_first(self._at_walkers), moved_first(self._at_doors)

    def update(self, places: Floats, radii: Floats, judged: int | None = None) -> None:
        """Judge the discs where they are now.

        Args:
            places: Middles, shape (N, 2), metres.
            radii: Radii, shape (N,), metres.
            judged: Count only contacts in which one of so many discs, the first ones, takes part; None: all.
        """
        judged = len(places) if judged is None else judged
        self.began = set()
        self._judge_pairs(places, radii, judged)
        discs, edges = self._raster.touching(places[:judged], radii[:judged])
        at_wall = self._is_wall[edges]
        walls, boxes = set(discs[at_wall].tolist()), set(discs[~at_wall].tolist())
        self.with_walls += len(walls - self._at_walls)
        self.with_boxes += len(boxes - self._at_boxes)
        self._at_walls, self._at_boxes = walls, boxes

    def update_moving(self, places: Floats, radii: Floats, walkers: Floats, doors: Sequence[Block]) -> None:
        """Judge the discs beside what moves; there is little of it, so that all pairs are compared.

        Args:
            places: Middles, shape (N, 2), metres.
            radii: Radii, shape (N,), metres.
            walkers: Discs of walkers, shape (K, 3): x, y and radius, metres.
            doors: The leaves of doors.
        """
        at_walkers, at_doors = set(), set()
        for number, (x, y, radius) in enumerate(walkers.tolist()):
            near = np.hypot(places[:, 0] - x, places[:, 1] - y) < radii + radius
            at_walkers |= {(disc, number) for disc in np.flatnonzero(near).tolist()}
        for number, leaf in enumerate(doors):
            near = distances(places, np.array(leaf.edges), leaf) < radii
            at_doors |= {(disc, number) for disc in np.flatnonzero(near).tolist()}
        self.with_walkers += len(at_walkers - self._at_walkers)
        self.with_doors += len(at_doors - self._at_doors)
        self._at_walkers, self._at_doors = at_walkers, at_doors

    def _judge_pairs(self, places: Floats, radii: Floats, judged: int) -> None:
        if len(places) <= 1:
            return
        from scipy.spatial import cKDTree  # long to load, needed only for many discs

        tree, widest = cKDTree(places), 2 * float(radii.max())
        if self.min_separation == inf:
            # The nearest middles bound how far apart the nearest hulls can be.
            nearest = float(tree.query(places, k=2)[0][:, 1].min())
            within = nearest + widest - 2 * float(radii.min()) + 1e-9
        else:
            within = max(self.min_separation, 0.0) + widest
        pairs = tree.query_pairs(max(within, widest), output_type="ndarray")
        if not len(pairs):
            self._pairs = set()
            return
        first, second = pairs[:, 0], pairs[:, 1]
        apart = np.hypot(*(places[first] - places[second]).T) - radii[first] - radii[second]
        self.min_separation = min(self.min_separation, float(apart.min()))
        touching = {(int(a), int(b)) for a, b in pairs[(apart < 0) & (first < judged)]}
        self.began = touching - self._pairs
        self.with_robots += len(self.began)
        self._pairs = touching


def _distances(points: Floats, edges: Floats) -> Floats:
    """Return the distance of each point, shape (P, 2), from its edge, shape (P, 4); metres."""
    starts, ways = edges[:, :2], edges[:, 2:] - edges[:, :2]
    offsets = points - starts
    lengths = np.maximum((ways * ways).sum(axis=1), 1e-12)
    along = np.clip((offsets * ways).sum(axis=1) / lengths, 0.0, 1.0)
    rest = offsets - along[:, None] * ways
    apart: Floats = np.hypot(rest[:, 0], rest[:, 1])
    return apart
