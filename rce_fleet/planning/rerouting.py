"""New paths for some robots of a plan, between the visits of the others, which keep theirs if they can.

See :mod:`rce_fleet.planning.rerouting_loops` for the search, and :mod:`rce_fleet.planning.visits` for steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.motion import turns_on
from rce_fleet.planning.rerouting_loops import PLANNED, reroute_robots
from rce_fleet.planning.visit_lists import fill_lists, list_visits

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph
    from rce_fleet.planning.motion import Motion

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

REROUTING_KERNELS = (reroute_robots, fill_lists)
TOUCHED = 128
"""Robots that may lose their paths beside those that need new ones."""
LONGEST = 2048
"""Most nodes of a new path."""


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
    own_costs: Mapping[int, Ints] | None = None,
    motion: Motion | None = None,
) -> Rerouted | None:
    """Return new paths of ``members``, and of robots in their way.

    Args:
        graph: Where robots can drive.
        robots: Their paths.
        members: Robots that need new paths, in order; each is an index of ``robots``.
        effort: States of searches that are expanded at most.
        seed: Breaks ties.
        forbidden: Nodes that single robots must not enter.
        own_costs: Costs of all edges for single robots; those with the same costs share one array.
        motion: What turns cost, on a grid, with the heading of each robot at its start; None: nothing.

    Returns:
        The new paths; None if not all of them were found.
    """
    size, count = len(graph), len(robots.starts)
    routes_at = routes_begin(robots.lengths)
    counts, times, tags = list_visits(
        size, robots.starts, robots.goals, routes_at, robots.nodes, robots.steps, robots.fixed
    )
    closed_at, closed = closed_rows(forbidden, count)
    costs_at, costs = cost_rows(graph, count, own_costs or {})
    directions, turns, headings = turns_on(graph, motion, count)
    touched = len(members) + TOUCHED
    slots, lengths = np.full(count, -1, np.int32), np.full(touched, PLANNED, np.int32)
    nodes, steps = np.empty((touched, LONGEST), np.int32), np.empty((touched, LONGEST))
    is_free = ~np.isin(robots.rests, robots.goals) & np.isin(robots.rests, graph.neighbours)
    targets = np.where(robots.goals >= 0, robots.goals, np.where(is_free, robots.rests, -1)).astype(np.int32)
    done = reroute_robots(
        graph.indptr, graph.neighbours, costs_at, costs, graph.reverse.indptr, graph.reverse.neighbours,
        directions, turns, robots.starts, headings, robots.begins, robots.goals, targets, closed_at, closed,
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


def routes_begin(lengths: Ints) -> Ints:
    """Return where each robot's path begins in arrays of all paths, shape (robots + 1,)."""
    return np.concatenate(([0], np.cumsum(lengths))).astype(np.int32)


def closed_rows(forbidden: Mapping[int, frozenset[int]] | None, count: int) -> tuple[Ints, Ints]:
    """Return where the forbidden nodes of each robot begin, shape (robots + 1,), and these nodes."""
    closed_of = [sorted((forbidden or {}).get(robot, ())) for robot in range(count)] if forbidden else []
    closed_at = np.zeros(count + 1, np.int32)
    closed_at[1:] = np.cumsum([len(closed) for closed in closed_of]) if closed_of else 0
    return closed_at, np.array([node for closed in closed_of for node in closed], np.int32)


def cost_rows(graph: PlanningGraph, count: int, own_costs: Mapping[int, Ints]) -> tuple[Ints, Ints]:
    """Return the row of costs of each robot, shape (robots,), and these rows, shape (rows, edges)."""
    rows, row_of = [graph.costs], {id(graph.costs): 0}
    costs_at = np.zeros(count, np.int32)
    for robot, costs in own_costs.items():
        if id(costs) not in row_of:
            row_of[id(costs)] = len(rows)
            rows.append(costs)
        costs_at[robot] = row_of[id(costs)]
    return costs_at, np.ascontiguousarray(rows, np.int32)
