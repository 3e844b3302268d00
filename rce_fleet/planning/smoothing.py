"""Makes paths of a joint plan straighter, among the paths of all others.

Large-neighbourhood search as in ``improvement``, but the cost of a path counts its turns and stops beside its
steps. The search is A* over the last edge, which gives the heading, and the step, with the exact distances on
the line graph of ``motion`` as heuristic.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.planning.motion import UNITS
from rce_fleet.planning.pibt import ROTATIONS
from rce_fleet.planning.swap import draw
from rce_fleet.planning.window import is_free, occupy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph
    from rce_fleet.planning.motion import Turning

    Ints = NDArray[np.int32]

GROUP = 8
"""Most robots that are planned anew together."""
_MAX_STATES = 30_000
"""States of one search at most; each takes 24 bytes."""
_ATTEMPT = 10
"""What the choice of a group counts for, in states."""
MAX_SCRATCH = 30_000_000
"""Edges times steps up to which plans are smoothed; four bytes each."""


@helper
def _path_cost(
    indptr: Ints,
    neighbours: Ints,
    directions: Ints,
    turns: Ints,
    stop: int,
    facing: int,
    goal: int,
    path: Ints,
) -> int:
    """Return the cost of a path: its steps until it stays at the goal, its turns, its stops; units."""
    last = len(path) - 1
    while last > 0 and path[last - 1] == goal:
        last -= 1
    cost, moved = last * UNITS, False
    for step in range(last):
        if path[step] == path[step + 1]:
            cost += stop if moved else 0
            moved = False
            continue
        for edge in range(indptr[path[step]], indptr[path[step] + 1]):
            if neighbours[edge] == path[step + 1]:
                cost += turns[facing, directions[edge]]
                facing = directions[edge]
        moved = True
    return cost


@helper
def _least(indptr: Ints, aims: Ints, directions: Ints, turns: Ints, start: int, facing: int) -> int:
    """Return what a robot pays if no other robot is in its way; ``aims`` are its own, shape (edges,)."""
    least = 1 << 29
    for edge in range(indptr[start], indptr[start + 1]):
        least = min(least, aims[edge] + turns[facing, directions[edge]])
    return least


@helper
def _search(
    indptr: Ints,
    neighbours: Ints,
    directions: Ints,
    turns: Ints,
    stop: int,
    aims: Ints,
    goal: int,
    start: int,
    facing: int,
    most: int,
    flags: int,
    paths: Ints,
    occupants: Ints,
    seen: Ints,
    mark: int,
    pool: Ints,
    heads: Ints,
    path: Ints,
    random: NDArray[np.int64],
) -> tuple[int, int]:
    """Write the cheapest path of at most the cost ``most``; return its cost or -1, and states visited."""
    last, edges = paths.shape[1] - 1, len(neighbours)
    least = 0 if start == goal else _least(indptr, aims, directions, turns, start, facing)
    levels = min(most - least + 1, len(heads))
    for level in range(max(levels, 0)):
        heads[level] = -1
    free_from = last  # from this step on no other robot is in the goal
    while free_from > 0 and occupants[free_from - 1, goal] < 0:
        free_from -= 1
    if levels < 1 or occupants[last, goal] >= 0:
        return -1, 1
    # Node, edge that led there, step, cost, next in the stack, predecessor; whether it moved is in the path.
    pool[0, 0], pool[0, 1], pool[0, 2], pool[0, 3], pool[0, 4], pool[0, 5] = start, edges, 0, 0, -1, -1
    heads[0] = 0
    used, level, visited = 1, 0, 0
    while level < levels:
        entry = heads[level]
        if entry < 0:
            level += 1
            continue
        heads[level] = pool[entry, 4]
        here, slot, step, spent = pool[entry, 0], pool[entry, 1], pool[entry, 2], pool[entry, 3]
        if seen[step, slot] == mark:
            continue
        seen[step, slot] = mark
        visited += 1
        if here == goal and step >= free_from:
            for later in range(step, last + 1):
                path[later] = goal
            while entry >= 0:
                path[pool[entry, 2]] = pool[entry, 0]
                entry = pool[entry, 5]
            return level + least, visited
        if step == last:
            continue
        heading = facing if slot == edges else directions[slot]
        before = pool[entry, 5]
        has_moved = before >= 0 and pool[before, 0] != here
        first, degree = indptr[here], indptr[here + 1] - indptr[here]
        around = draw(random) % (degree + 1)
        for index in range(-1, degree):
            edge = first + (index + around) % max(degree, 1)
            there = here if index < 0 else neighbours[edge]
            after = slot if index < 0 else edge
            if used >= len(pool) or seen[step + 1, after] == mark:
                continue
            cost = spent + UNITS
            rest = 0
            if index < 0:
                cost += stop if has_moved and here != goal else 0
                if here != goal:
                    rest = _least(indptr, aims, directions, turns, here, heading)
            else:
                if aims[edge] >= 1 << 29:
                    continue
                cost += turns[heading, directions[edge]]
                rest = 0 if there == goal else aims[edge] - UNITS
            place = max(cost + rest - least, level)
            if place >= levels or not is_free(step, here, there, flags, paths, occupants):
                continue
            pool[used, 0], pool[used, 1], pool[used, 2], pool[used, 3] = there, after, step + 1, cost
            pool[used, 4], pool[used, 5] = heads[place], entry
            heads[place] = used
            used += 1
    return -1, visited


@helper
def _gather(
    worst: int,
    size: int,
    indptr: Ints,
    neighbours: Ints,
    paths: Ints,
    occupants: Ints,
    members: Ints,
    random: NDArray[np.int64],
) -> int:
    """Write robots that are near to places of one robot's path into ``members``; return their number."""
    members[0] = worst
    count = 1
    for _ in range(4 * size):
        if count >= size:
            break
        step = draw(random) % paths.shape[1]
        node = paths[worst, step]
        degree = indptr[node + 1] - indptr[node]
        around = draw(random) % (degree + 1)
        if around < degree:
            node = neighbours[indptr[node] + around]
        for later in range(max(step - 1, 0), min(step + 2, paths.shape[1])):
            other = occupants[later, node]
            is_new = other >= 0 and count < size
            for index in range(count):
                is_new = is_new and members[index] != other
            if is_new:
                members[count] = other
                count += 1
    return count


def _smooth(
    indptr: Ints,
    neighbours: Ints,
    directions: Ints,
    turns: Ints,
    stop: int,
    aims: Ints,
    goals: Ints,
    headings: Ints,
    flags: int,
    effort: int,
    paths: Ints,
    random: NDArray[np.int64],
) -> int:
    """Plan every robot alone, then groups of robots anew, and keep what is not worse.

    Args:
        indptr: The graph.
        neighbours: The graph.
        directions: See :class:`~rce_fleet.planning.motion.Turning`, also for ``turns`` and ``aims``.
        turns: See there.
        stop: Cost of a stop, units.
        aims: See there; every edge must cost one step.
        goals: Goal of each robot.
        headings: Heading of each robot at its start.
        flags: See :mod:`~rce_fleet.planning.pibt`.
        effort: States that are visited at most, about.
        paths: Node of each robot at each step, shape (robots, steps + 1); changed.
        random: State of the random numbers.

    Returns:
        By how many units the plan became cheaper.
    """
    robots, steps = paths.shape
    nodes, edges = len(indptr) - 1, len(neighbours)
    occupants = np.full((steps, nodes), -1, np.int32)
    seen = np.zeros((steps, edges + 1), np.int32)
    pool = np.empty((_MAX_STATES, 6), np.int32)
    heads = np.empty(4096, np.int32)
    members = np.zeros(GROUP, np.int32)
    old = np.zeros((GROUP, steps), np.int32)
    fresh = np.zeros(GROUP, np.int32)
    spent = np.zeros(robots, np.int32)
    least = np.zeros(robots, np.int32)
    for robot in range(robots):
        occupy(robot, paths, occupants, robot)
        start, facing = paths[robot, 0], headings[robot]
        spent[robot] = _path_cost(
            indptr, neighbours, directions, turns, stop, facing, goals[robot], paths[robot]
        )
        if start != goals[robot]:
            least[robot] = _least(indptr, aims[robot], directions, turns, start, facing)
    gain, mark, attempt, work = 0, 0, -1, 0
    excess = int(spent.sum()) - int(least.sum())
    while work < effort and excess > gain:
        attempt += 1
        work += _ATTEMPT
        worst, count = attempt, 1
        if attempt >= robots:
            worst = draw(random) % robots
            for _ in range(4):
                other = draw(random) % robots
                if spent[other] - least[other] > spent[worst] - least[worst]:
                    worst = other
        if spent[worst] <= least[worst]:
            continue
        members[0] = worst
        if attempt >= robots:
            size = min(2 + draw(random) % (GROUP - 1), robots)
            count = _gather(worst, size, indptr, neighbours, paths, occupants, members, random)
        before, rest = 0, 0
        for index in range(count):
            other = draw(random) % (index + 1)
            members[index], members[other] = members[other], members[index]
        for index in range(count):
            before += spent[members[index]]
            rest += least[members[index]]
            old[index] = paths[members[index]]
            occupy(members[index], paths, occupants, -1)
        total, planned = 0, 0
        while planned < count:
            robot = members[planned]
            rest -= least[robot]
            mark += 1
            cost, visited = _search(
                indptr, neighbours, directions, turns, stop, aims[robot], goals[robot], old[planned, 0],
                headings[robot], before - total - rest, flags, paths, occupants, seen, mark, pool, heads,
                paths[robot], random,
            )  # fmt: skip
            work += visited
            if cost < 0:
                break
            total += cost
            fresh[planned] = cost
            occupy(robot, paths, occupants, robot)
            planned += 1
        if planned == count:
            gain += before - total
            for index in range(count):
                spent[members[index]] = fresh[index]
            continue
        for index in range(planned):
            occupy(members[index], paths, occupants, -1)
        for index in range(count):
            paths[members[index]] = old[index]
            occupy(members[index], paths, occupants, members[index])
    return gain


_ROW, _TABLE = "int32[::1]", "int32[:, ::1]"
smooth = kernel(
    f"int64({_ROW}, {_ROW}, {_ROW}, {_TABLE}, int64, {_TABLE}, {_ROW}, {_ROW}, int64, int64, {_TABLE}, "
    "int64[::1])",
    numpy=_smooth,
)(_smooth)


def smoothed(
    graph: PlanningGraph,
    cells: Ints,
    goals: Ints,
    turning: Turning,
    *,
    stop: float,
    rotations: bool,
    effort: int,
    seed: int,
) -> Ints:
    """Return a complete plan with turns and stops counted, shape (steps + 1, robots).

    Args:
        graph: Where robots drive; each edge costs one step.
        cells: The plan, shape (steps + 1, robots).
        goals: Goal of each robot.
        turning: Made for this graph.
        stop: See :class:`~rce_fleet.planning.motion.Motion`.
        rotations: See :class:`~rce_fleet.planning.planner.PlanningProblem`.
        effort: States of searches, each an edge and a step, that are visited at most, about.
        seed: Of the random numbers.
    """
    if cells.shape[0] * len(turning.directions) > MAX_SCRATCH:
        return cells
    paths = np.ascontiguousarray(cells.T)
    random = np.array([(seed * 2654435761 + 71) & 0x7FFFFFFF], np.int64)
    smooth(
        graph.indptr, graph.neighbours, turning.directions, turning.costs, round(stop * UNITS), turning.table,
        goals, turning.headings, ROTATIONS if rotations else 0, effort, paths, random,
    )  # fmt: skip
    is_away = (paths != goals[:, None]).any(axis=0)
    return np.ascontiguousarray(paths[:, : int(is_away.nonzero()[0].max(initial=-1)) + 2].T)
