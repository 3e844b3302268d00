"""Better paths for robots that drive: large-neighbourhood search on the visits of all robots.

It starts from paths that robots have, and leaves each robot where its path begins. So it serves again and
again while robots drive; ``improvement`` makes a joint plan better before it is carried out. See
:mod:`rce_fleet.planning.path_improvement_loops` for the search.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.motion import turns_on
from rce_fleet.planning.path_improvement_loops import improve_paths
from rce_fleet.planning.rerouting import closed_rows, cost_rows, routes_begin
from rce_fleet.planning.visit_lists import fill_lists, list_visits
from rce_fleet.planning.visit_search import HEADINGS

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph
    from rce_fleet.planning.motion import Motion
    from rce_fleet.planning.rerouting import RoutedRobots

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

PATH_IMPROVEMENT_KERNELS = (improve_paths, fill_lists)
MOST_DISTANCES = 150_000_000
"""Robots times nodes up to which paths are improved; four bytes each are used where they are needed."""
_LONGER = 64
"""Most nodes that a new path may have more than the longest one."""
_IN_VAIN = 2
"""The search ends after so many groups by robot without a gain, ..."""
_IN_VAIN_AT_LEAST = 16
"""... and so many more."""
_LOOK = 0.005
"""Seconds between two looks at the clock, about."""


@dataclass(frozen=True, eq=False)
class ImprovedPaths:
    """New paths of some robots, for which all of them arrive earlier in all.

    Attributes:
        paths: Nodes and steps after its start, by robot; each ends at the robot's goal.
        gain: By how many steps they arrive earlier in all.
        is_done: Whether the search ended because it found nothing more.
    """

    paths: dict[int, tuple[Ints, Floats]]
    gain: float = 0.0
    is_done: bool = True


def improved(
    graph: PlanningGraph,
    robots: RoutedRobots,
    *,
    seconds: float,
    effort: int,
    seed: int = 0,
    forbidden: Mapping[int, frozenset[int]] | None = None,
    own_costs: Mapping[int, Ints] | None = None,
    motion: Motion | None = None,
    urgent: Collection[int] = (),
) -> ImprovedPaths:
    """Return paths with which robots arrive earlier in all, among the paths of the others.

    Only robots whose paths end at their goals get other ones. Where ``seconds`` do not end the search before
    ``effort`` does, the same arguments give the same paths.

    Args:
        graph: Where robots can drive.
        robots: Their paths.
        seconds: Time for the search.
        effort: States of searches that are expanded at most.
        seed: Of the random numbers.
        forbidden: Nodes that single robots must not enter.
        own_costs: Costs of all edges for single robots; those with the same costs share one array.
        motion: What turns cost, on a grid, with the heading of each robot at its start; None: nothing.
        urgent: Robots that must not arrive later than before for the sake of others.
    """
    deadline = perf_counter() + seconds
    size, count = len(graph), len(robots.starts)
    routes_at = routes_begin(robots.lengths)
    has_path = robots.lengths > 0
    ends = np.where(has_path, np.append(robots.nodes, -1)[routes_at[1:] - 1], -1)
    is_free = (has_path & (ends == robots.goals) & (robots.starts != robots.goals)).astype(np.int32)
    if count * size > MOST_DISTANCES or not is_free.any():
        return ImprovedPaths({})
    counts, times, tags = list_visits(
        size, robots.starts, robots.goals, routes_at, robots.nodes, robots.steps, robots.fixed
    )
    longest = int(robots.lengths.max()) + _LONGER
    nodes, steps = np.zeros((count, longest), np.int32), np.zeros((count, longest))
    row = np.repeat(np.arange(count), robots.lengths)
    column = np.arange(len(robots.nodes)) - routes_at[row]
    nodes[row, column], steps[row, column] = robots.nodes, robots.steps
    lengths, is_changed = robots.lengths.copy(), np.zeros(count, np.int32)
    is_goal, is_urgent = np.zeros(size, np.int32), np.zeros(count, np.int32)
    is_goal[robots.goals[robots.goals >= 0]] = 1
    is_urgent[list(urgent)] = 1
    closed_at, closed = closed_rows(forbidden, count)
    costs_at, costs = cost_rows(graph, count, own_costs or {})
    directions, turns, headings = turns_on(graph, motion, count)
    fields, is_known = np.empty((count, size), np.int32), np.zeros(count, np.int32)
    best = np.empty((size, times.shape[1] + 1, HEADINGS))
    marks = np.zeros(best.shape[:2], np.int32)
    state, random = np.zeros(3, np.int64), np.array([(seed * 2654435761 + 53) & 0x7FFFFFFF], np.int64)
    gain, tries, in_vain = 0.0, 1, _IN_VAIN * int(is_free.sum()) + _IN_VAIN_AT_LEAST
    while state[1] < effort and state[2] < in_vain and (began := perf_counter()) < deadline:
        gain += improve_paths(
            graph.indptr, graph.neighbours, costs_at, costs, graph.reverse.indptr, graph.reverse.neighbours,
            directions, turns, robots.starts, headings, robots.begins, robots.goals, closed_at, closed,
            robots.clock, is_free, is_urgent, tries, effort, counts, times, tags, lengths, nodes, steps,
            fields, is_known, is_goal, best, marks, state, is_changed, random,
        )  # fmt: skip
        tries = min(2 * tries, 64) if perf_counter() - began < _LOOK else max(tries // 2, 1)
    paths = {
        robot: (nodes[robot, : lengths[robot]], steps[robot, : lengths[robot]])
        for robot in np.flatnonzero(is_changed).tolist()
    }
    return ImprovedPaths(paths, gain, is_done=bool(state[2] >= in_vain))
