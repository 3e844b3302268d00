"""Final refinement: all keyscans that see the same walls are aligned in pairs.

The edges of the front end tie each keyscan to its predecessors, and loops tie single keyscans. The pairs
tie all passes along a wall to each other, so walls get as thin as the laser measures them.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rce_fleet.geometry.angles import wrap_array
from rce_fleet.geometry.poses import relative
from rce_fleet.mapping.graph.alignment import Reference, align
from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph

RADIUS = 2.5
"""Keyscans nearer than this to each other are aligned, metres."""
PARTNERS = 6
"""A keyscan is aligned to at most so many earlier ones besides its predecessors."""
SUCCESSIVE = 2
"""A keyscan is aligned to so many predecessors."""
SPACING = 4
"""Partners are this many keyscans apart from each other, so that they are of several passes."""
TURN_AS_METRES = 0.3
"""How much a difference of heading counts against a partner, metres per radian."""
REACHES = (0.25, 0.15, 0.1, 0.1)
LEAST_INLIERS = 0.35
GREATEST_CHANGE = 0.25
"""Alignments that move a keyscan farther than this, metres, are wrong: the graph is better than that."""


def pairs(graph: KeyGraph) -> list[tuple[int, int]]:
    """Return pairs of keyscans that probably see the same walls, each with the smaller number first."""
    positions, yaws, parts = graph.poses[:, :2], graph.poses[:, 2], graph.parts
    tree = cKDTree(positions)
    found: set[tuple[int, int]] = set()
    for key in range(len(graph)):
        near = np.array(tree.query_ball_point(positions[key], RADIUS))
        near = near[(near < key) & (parts[near] == parts[key])]
        apart = np.hypot(*(positions[near] - positions[key]).T)
        turn = np.abs(wrap_array(yaws[near] - yaws[key]))
        chosen: list[int] = []
        for other in near[np.argsort(apart + TURN_AS_METRES * turn)].tolist():
            if key - other <= SUCCESSIVE:
                found.add((other, key))
            elif len(chosen) < PARTNERS and all(abs(other - one) > SPACING for one in chosen):
                chosen.append(other)
        found.update((other, key) for other in chosen)
    return sorted(found)


def refine(graph: KeyGraph) -> None:
    """Align keyscans in pairs and optimize the graph; the pairs replace those of the refinement before."""
    references: dict[int, Reference] = {}
    edges: list[Edge] = []
    for first, second in pairs(graph):
        if first not in references:
            references[first] = Reference(graph.scans[first].line_points, graph.scans[first].line_normals)
        start = relative(graph.poses[first], graph.poses[second])
        aligned = align(graph.scans[second], references[first], start, reaches=REACHES)
        shift = np.abs(aligned.pose[:2] - start[:2]).max()
        if aligned.inliers >= LEAST_INLIERS and shift <= GREATEST_CHANGE:
            edges.append(Edge(first, second, aligned.pose, aligned.information, 0.0, is_loop=True))
    graph.refined = edges
    graph.optimize()
