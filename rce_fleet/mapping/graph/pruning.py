"""Pruning: of many keyscans of one place some are kept, so that the graph of a known place does not grow.

Of each place and heading the oldest keyscans stay, which hold the map where it is, and the newest, which show
how the place looks now. What the edges of a removed keyscan tell goes into edges between its neighbours: a
tree of them, as in Kretzschmar and Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", IJRR 31 (2012), instead of all pairs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, inverse
from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray


PLACE = 0.6
"""Edge of a place, metres: two keyscans of each pass."""
HEADINGS = 6
"""Headings that are told apart."""
OLDEST, NEWEST = 2, 4
"""So many keyscans of a place and heading are kept."""
MOST_LOOPS = 6
"""A keyscan takes over loops of removed ones until it has so many."""
LEAST_INFORMATION = 1e-3
"""Keeps directions without any information invertible, 1 / square metres."""


def surplus(graph: KeyGraph, protected: Iterable[int]) -> list[int]:
    """Return keyscans that others of the same place and heading make needless, ascending.

    Args:
        graph: The graph.
        protected: Keyscans that stay. The first one of each part stays too.
    """
    kept = {*protected, *np.unique(graph.parts).tolist()}
    cells = np.floor(graph.poses[:, :2] / PLACE).astype(np.int64)
    sectors = np.floor(graph.poses[:, 2] / (2 * np.pi) * HEADINGS + 0.5).astype(np.int64) % HEADINGS
    places: dict[tuple[int, ...], list[int]] = {}
    for key, place in enumerate(np.column_stack((graph.parts, cells, sectors)).tolist()):
        places.setdefault(tuple(place), []).append(key)
    between = (keys[OLDEST : max(OLDEST, len(keys) - NEWEST)] for keys in places.values())
    return sorted(key for keys in between for key in keys if key not in kept)


def remove(graph: KeyGraph, keys: Iterable[int]) -> NDArray[np.int64]:
    """Remove keyscans, and join their neighbours instead.

    Args:
        graph: The graph.
        keys: Keyscans to remove; none is the first one of its part.

    Returns:
        The new number of each keyscan, -1 of those that were removed, shape (N,).
    """
    edges_of: dict[int, list[Edge]] = {}
    for edge in graph.edges:
        for end in (edge.first, edge.second):
            edges_of.setdefault(end, []).append(edge)
    removed = sorted(keys)
    for key in removed:
        for made in _around(graph, key, edges_of):
            for end in (made.first, made.second):
                edges_of[end].append(made)
    left = {id(edge): edge for edges in edges_of.values() for edge in edges}
    gone = set(removed)
    numbers = np.full(len(graph), -1, np.int64)
    numbers[[key for key in range(len(graph)) if key not in gone]] = np.arange(len(graph) - len(gone))
    graph.keep(numbers, [_renumbered(edge, numbers) for edge in left.values()])
    return numbers


def _renumbered(edge: Edge, numbers: NDArray[np.int64]) -> Edge:
    return replace(edge, first=int(numbers[edge.first]), second=int(numbers[edge.second]))


def _around(graph: KeyGraph, key: int, edges_of: dict[int, list[Edge]]) -> list[Edge]:
    """Take a keyscan's edges away, and return those that replace them.

    One of the keyscan's neighbours on its robot's way becomes the hub that the others are joined to.
    """
    edges = [edge if edge.first == key else _reversed(edge) for edge in edges_of.pop(key, [])]
    for edge in edges:
        others = edges_of[edge.second]
        edges_of[edge.second] = [other for other in others if key not in (other.first, other.second)]
    way = sorted((edge for edge in edges if not edge.is_loop), key=_uncertainty)
    loops = sorted((edge for edge in edges if edge.is_loop), key=_uncertainty)
    if not way:
        return []
    hub = way[0]
    made = {edge.second: _joined(hub, edge) for edge in way[1:] if edge.second != hub.second}
    robots = {
        graph.robots[other.second if other.first == hub.second else other.first]
        for other in edges_of[hub.second]
        if other.is_loop
    }
    room = MOST_LOOPS - sum(other.is_loop for other in edges_of[hub.second])
    for edge in loops:
        robot = graph.robots[edge.second]
        if edge.second == hub.second or edge.second in made or (room <= 0 and robot in robots):
            continue
        made[edge.second] = _joined(hub, edge)
        robots.add(robot)
        room -= 1
    return list(made.values())


def _uncertainty(edge: Edge) -> float:
    return float(np.trace(_covariance(edge.information)))


def _covariance(information: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.inv(information + LEAST_INFORMATION * np.eye(3)), np.float64)


def _reversed(edge: Edge) -> Edge:
    """Return an edge measured from its other end."""
    pose = inverse(edge.pose)
    c, s = np.cos(edge.pose[2]), np.sin(edge.pose[2])
    turn = np.array(((-c, -s, pose[1]), (s, -c, -pose[0]), (0.0, 0.0, -1.0)))
    information = np.linalg.inv(turn @ _covariance(edge.information) @ turn.T)
    return replace(edge, first=edge.second, second=edge.first, pose=pose, information=information)


def _joined(one: Edge, two: Edge) -> Edge:
    """Return the edge between the second ends of two edges that begin at the same keyscan.

    It is measured from the earlier one.
    """
    if one.second > two.second:
        one, two = two, one
    back = _reversed(one)
    c, s = np.cos(back.pose[2]), np.sin(back.pose[2])
    x, y = two.pose[:2]
    by_first = np.array(((1.0, 0.0, -s * x - c * y), (0.0, 1.0, c * x - s * y), (0.0, 0.0, 1.0)))
    by_second = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    covariance = (
        by_first @ _covariance(back.information) @ by_first.T
        + by_second @ _covariance(two.information) @ by_second.T
    )
    return Edge(
        back.first,
        two.second,
        compose(back.pose, two.pose),
        np.linalg.inv(covariance),
        one.length + two.length,
        is_loop=one.is_loop or two.is_loop,
    )
