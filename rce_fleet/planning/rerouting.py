"""New paths for some robots of a plan, between the visits of the others, which keep theirs if they can.

See :mod:`rce_fleet.planning.rerouting_loops` for the search, and :mod:`rce_fleet.planning.visits` for steps.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.rerouting_loops import PLANNED, reroute_robots
from rce_fleet.planning.visits import DWELL, ENTER, LEAVE, NEXT, ROBOT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

TOUCHED = 128
"""Robots that may lose their paths beside those that need new ones."""
LONGEST = 2048
"""Most nodes of a new path."""
_LISTED = 32
"""Visits that are added to a node at most."""


@dataclass(frozen=True, eq=False)
class Rerouted:
    """New paths.

    Attributes:
        paths: Nodes and steps after its start, by robot.
        unreachable: Robots, of those that were looked at, whose goals cannot be reached.
    """

    paths: dict[int, tuple[Ints, Floats]]
    unreachable: frozenset[int]


@dataclass(frozen=True, eq=False)
class RoutedRobots:
    """The paths of robots, as they are.

    Attributes:
        starts: Node of each robot, shape (robots,).
        begins: Step at which it entered it, shape (robots,).
        goals: Goal of each robot, or -1; shape (robots,).
        rests: Where a robot without a goal ends, or -1: in any node that the others do not need.
        lengths: Nodes that it enters after its start, shape (robots,).
        nodes: These nodes, one robot's after another's.
        steps: When they are entered.
        fixed: Visits that are not changed, ``(node, step of leaving it)``: of nodes that robots are in, or
            will drive through before their starts, and of robots that are not planned.
        clock: Step that the robots have reached, about.
    """

    starts: Ints
    begins: Floats
    goals: Ints
    rests: Ints
    lengths: Ints
    nodes: Ints
    steps: Floats
    fixed: tuple[Ints, Floats]
    clock: float


def reroute(
    graph: PlanningGraph,
    robots: RoutedRobots,
    members: Sequence[int],
    *,
    effort: int,
    seed: int = 0,
    forbidden: Mapping[int, frozenset[int]] | None = None,
) -> Rerouted | None:
    """Return new paths of ``members``, and of robots in their way.

    Args:
        graph: Where robots can drive.
        robots: Their paths.
        members: Robots that need new paths, in order; each is an index of ``robots``.
        effort: States of searches that are expanded at most.
        seed: Breaks ties.
        forbidden: Nodes that single robots must not enter.

    Returns:
        The new paths; None if not all of them were found.
    """
    size, count = len(graph), len(robots.starts)
    routes_at = np.concatenate(([0], np.cumsum(robots.lengths))).astype(np.int32)
    counts, times, tags = _listed(size, robots, routes_at)
    closed_of = [sorted((forbidden or {}).get(robot, ())) for robot in range(count)] if forbidden else []
    closed_at = np.zeros(count + 1, np.int32)
    closed_at[1:] = np.cumsum([len(closed) for closed in closed_of]) if closed_of else 0
    touched = len(members) + TOUCHED
    slots, lengths = np.full(count, -1, np.int32), np.full(touched, PLANNED, np.int32)
    nodes, steps = np.empty((touched, LONGEST), np.int32), np.empty((touched, LONGEST))
    is_free = ~np.isin(robots.rests, robots.goals) & np.isin(robots.rests, graph.neighbours)
    targets = np.where(robots.goals >= 0, robots.goals, np.where(is_free, robots.rests, -1)).astype(np.int32)
    done = reroute_robots(
        graph.indptr, graph.neighbours, graph.costs, graph.reverse.indptr, graph.reverse.neighbours,
        robots.starts, robots.begins, robots.goals, targets, closed_at,
        np.array([node for closed in closed_of for node in closed], np.int32),
        routes_at, robots.nodes, robots.steps, robots.clock, effort, np.array(members, np.int32),
        counts, times, tags, slots, lengths, nodes, steps, np.array([seed + 1], np.int64),
    )  # fmt: skip
    if not done:
        return None
    paths = {
        int(robot): (nodes[slot, : lengths[slot]], steps[slot, : lengths[slot]])
        for robot in np.flatnonzero(slots >= 0)
        if lengths[slot := slots[robot]] >= 0
    }
    unreachable = frozenset(robot for robot in paths if robots.goals[robot] >= 0 > targets[robot])
    return Rerouted(paths, unreachable)


class _Buffers(threading.local):
    """Memory that is used again with the next call: the pages of new memory cost more than the lists."""

    def __init__(self) -> None:
        self._times = np.empty(0)
        self._tags = np.empty(0, np.int32)

    def times(self, size: int, room: int) -> Floats:
        """Return an array of shape (size, room, 2); its content is undefined."""
        needed = size * room * 2
        if len(self._times) < needed:
            self._times = np.empty(needed + needed // 4)
        return self._times[:needed].reshape(size, room, 2)

    def tags(self, size: int, room: int) -> Ints:
        """Return an array of shape (size, room, 2); its content is undefined."""
        needed = size * room * 2
        if len(self._tags) < needed:
            self._tags = np.empty(needed + needed // 4, np.int32)
        return self._tags[:needed].reshape(size, room, 2)


_buffers = _Buffers()


def _listed(size: int, robots: RoutedRobots, routes_at: Ints) -> tuple[Ints, Floats, Ints]:
    """Return the number, times and tags of each node's visits, in order."""
    count, total = len(robots.starts), len(robots.nodes)
    first, last = routes_at[:-1], routes_at[1:]
    has_path = robots.lengths > 0
    leaves, ahead = np.full(total, np.inf), np.full(total, -1, np.int32)
    if total:
        leaves[:-1], ahead[:-1] = robots.steps[1:], robots.nodes[1:]
        ends = last[has_path] - 1
        is_rest = robots.nodes[ends] == robots.goals[has_path]
        leaves[ends], ahead[ends] = np.where(is_rest, robots.steps[ends] + DWELL, np.inf), -1
    starts_leave, starts_ahead = np.full(count, np.inf), np.full(count, -1, np.int32)
    starts_leave[has_path] = robots.steps[first[has_path]]
    starts_ahead[has_path] = robots.nodes[first[has_path]]
    others, others_leave = robots.fixed
    none = np.full(len(others), -1, np.int32)
    node = np.concatenate((robots.starts, others, robots.nodes))
    enter = np.concatenate((np.full(count + len(others), -np.inf), robots.steps))
    leave = np.concatenate((starts_leave, others_leave, leaves))
    robot = np.concatenate(
        (np.arange(count, dtype=np.int32), none, np.repeat(np.arange(count, dtype=np.int32), robots.lengths))
    )
    following = np.concatenate((starts_ahead, none, ahead))
    order = np.argsort(enter)
    # By node, then by step: a stable sort of numbers of 16 bits is a radix sort.
    short = np.uint16 if size <= 1 << 16 else np.int32
    order = order[np.argsort(node[order].astype(short), kind="stable")]
    node = node[order]
    counts = np.bincount(node, minlength=size).astype(np.int32)
    begins = np.concatenate(([0], np.cumsum(counts)[:-1]))
    place = np.arange(len(node)) - begins[node]
    room = int(counts.max(initial=0)) + _LISTED
    times, tags = _buffers.times(size, room), _buffers.tags(size, room)
    enter, leave = enter[order], leave[order]
    is_followed = np.append(node[1:] == node[:-1], False) & (following[order] < 0) & (leave < np.inf)
    leave[:-1] = np.where(is_followed[:-1], np.minimum(leave[:-1], enter[1:]), leave[:-1])
    times[node, place, ENTER], times[node, place, LEAVE] = enter, leave
    tags[node, place, ROBOT], tags[node, place, NEXT] = robot[order], following[order]
    return counts, times, tags
