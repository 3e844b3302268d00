"""Search for robots' paths over the next steps, on their way through several goals.

Only the steps of a window are planned. What a robot still has to drive after it is counted by its distances
to the goals that are known. So the search is A* over node, step and number of goals reached, with exact
distances as heuristic, and ends at the last step of the window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.planning.pibt import ROTATIONS
from rce_fleet.planning.swap import draw

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]

GROUP = 16
"""Most robots that are planned anew together."""
_WALKS = 8
"""Walks to find the robots of a group."""


@helper
def _rest(table: Ints, base: Ints, goals: Ints, robot: int, reached: int, node: int) -> int:
    """Return what a robot still has to drive from ``node`` through its known goals."""
    known = goals.shape[1]
    if reached >= known:
        return 0
    return int(table[robot * known + reached, node] + base[robot, reached])


@helper
def is_free(step: int, here: int, there: int, flags: int, paths: Ints, occupants: Ints) -> bool:
    """Return whether a robot can go from ``here`` at ``step`` to ``there``, or stay."""
    if occupants[step + 1, there] >= 0:
        return False
    if here == there:
        return True
    other = occupants[step, there]
    for _ in range(len(paths)):
        if other < 0:
            break
        ahead = paths[other, step + 1]
        if ahead == here:
            return False
        if flags & ROTATIONS:
            break
        other = occupants[step, ahead]
    return True


@helper
def _search(
    indptr: Ints,
    neighbours: Ints,
    costs: Ints,
    table: Ints,
    base: Ints,
    goals: Ints,
    robot: int,
    start: int,
    most: int,
    far: int,
    flags: int,
    paths: Ints,
    occupants: Ints,
    seen: Ints,
    mark: int,
    pool: Ints,
    heads: Ints,
    random: NDArray[np.int64],
) -> int:
    """Write the cheapest path into ``paths[robot]``; return its cost, or -1 if there is none."""
    window = paths.shape[1] - 1
    known = goals.shape[1]
    least = _rest(table, base, goals, robot, 0, start)
    levels = min(most - least + 1, len(heads))
    for level in range(levels):
        heads[level] = -1
    if levels < 1:
        return -1
    pool[0, 0], pool[0, 1], pool[0, 2], pool[0, 3], pool[0, 4] = start, 0, 0, -1, -1
    heads[0] = 0
    used, level = 1, 0
    while level < levels:
        entry = heads[level]
        if entry < 0:
            level += 1
            continue
        heads[level] = pool[entry, 3]
        here, reached, spent = pool[entry, 0], pool[entry, 1] % (known + 1), pool[entry, 2]
        step = pool[entry, 1] // (known + 1)
        if step == window:
            while entry >= 0:
                paths[robot, step] = pool[entry, 0]
                entry = pool[entry, 4]
                step -= 1
            return level + least
        first = indptr[here]
        degree = indptr[here + 1] - first
        turn = draw(random) % (degree + 1)
        for index in range(-1, degree):
            # The node itself first, so that waiting is tried last: the stacks are read from the top.
            edge = first + (index + turn) % max(degree, 1)
            there = here if index < 0 else neighbours[edge]
            count = reached
            while count < known and goals[robot, count] == there:
                count += 1
            slot = (there * (known + 1)) + count
            if seen[step + 1, slot] == mark or used >= len(pool):
                continue
            if index >= 0 and reached < known and table[robot * known + reached, there] >= far:
                continue
            cost = spent + (costs[0] if index < 0 else costs[1 + edge])
            place = cost + _rest(table, base, goals, robot, count, there) - least
            if place >= levels or not is_free(step, here, there, flags, paths, occupants):
                continue
            place = max(place, level)
            seen[step + 1, slot] = mark
            pool[used, 0], pool[used, 1], pool[used, 2] = there, (step + 1) * (known + 1) + count, cost
            pool[used, 3], pool[used, 4] = heads[place], entry
            heads[place] = used
            used += 1
    return -1


@helper
def occupy(robot: int, paths: Ints, occupants: Ints, value: int) -> None:
    """Write ``value`` where and when a robot is, shape of ``occupants``: (steps, nodes)."""
    for step in range(paths.shape[1]):
        occupants[step, paths[robot, step]] = value


@helper
def _to_first_goal(
    indptr: Ints, neighbours: Ints, costs: Ints, table: Ints, goals: Ints, robot: int, paths: Ints
) -> int:
    """Return what a robot pays until it is at the first of its known goals."""
    known, paid = goals.shape[1], 0
    for step in range(1, paths.shape[1]):
        here, there = paths[robot, step - 1], paths[robot, step]
        if here == there:
            paid += costs[0]
        for edge in range(indptr[here], indptr[here + 1]):
            if neighbours[edge] == there:
                paid += costs[1 + edge]
        if there == goals[robot, 0]:
            return paid
    return int(paid + table[robot * known, paths[robot, -1]])


def _improve_window(
    indptr: Ints,
    neighbours: Ints,
    costs: Ints,
    table: Ints,
    base: Ints,
    goals: Ints,
    far: int,
    flags: int,
    urgent: int,
    turn: int,
    begin: int,
    end: int,
    paths: Ints,
    paid: Ints,
    random: NDArray[np.int64],
) -> int:
    """Plan groups of robots anew within the window, and keep what is not worse.

    Args:
        indptr: The graph.
        neighbours: The graph.
        costs: Cost of waiting a step, then cost of each edge, shape (1 + edges,).
        table: Costs to each known goal of each robot, shape (robots * known, nodes).
        base: Costs from each known goal over the later ones, shape (robots, known).
        goals: Known goals of each robot, in order, shape (robots, known).
        far: Cost that means in ``table`` that no path exists.
        flags: See :mod:`~rce_fleet.planning.pibt`.
        urgent: Robot that must not be later at its first goal than before.
        turn: The robot to begin with.
        begin: Number of the first group. The first groups are each robot alone; others follow.
        end: Number behind the last group.
        paths: Node of each robot at each step of the window, shape (robots, steps + 1); changed.
        paid: Cost of each robot's path and of what it has to drive after it, shape (robots,); written.
        random: State of the random numbers.

    Returns:
        Number of groups whose paths became cheaper.
    """
    robots, steps = paths.shape
    nodes, known = len(indptr) - 1, goals.shape[1]
    occupants = np.full((steps, nodes), -1, np.int32)
    seen = np.zeros((steps, nodes * (known + 1)), np.int32)
    pool = np.empty((20_000, 5), np.int32)
    heads = np.empty(4096, np.int32)
    members = np.zeros(GROUP, np.int32)
    old = np.zeros((GROUP, steps), np.int32)
    fresh = np.zeros(GROUP, np.int32)
    inside = np.full(robots, -1, np.int32)
    for robot in range(robots):
        occupy(robot, paths, occupants, robot)
        reached, cost = 0, 0
        for step in range(1, steps):
            here, there = paths[robot, step - 1], paths[robot, step]
            if here == there:
                cost += costs[0]
            for edge in range(indptr[here], indptr[here + 1]):
                if neighbours[edge] == there:
                    cost += costs[1 + edge]
            while reached < known and goals[robot, reached] == there:
                reached += 1
        paid[robot] = cost + _rest(table, base, goals, robot, reached, paths[robot, steps - 1])
    mark, better = 0, 0
    limit = _to_first_goal(indptr, neighbours, costs, table, goals, urgent, paths)
    for attempt in range(begin, end):
        # Every robot alone first, then groups around robots that lose much.
        worst = (attempt + turn) % robots
        size = 1
        if attempt >= robots:
            worst = draw(random) % robots
            loss = paid[worst] - _rest(table, base, goals, worst, 0, paths[worst, 0])
            for _ in range(4):
                other = draw(random) % robots
                others = paid[other] - _rest(table, base, goals, other, 0, paths[other, 0])
                if others > loss:
                    worst, loss = other, others
            size = 2 + draw(random) % 7
        if paid[worst] == _rest(table, base, goals, worst, 0, paths[worst, 0]):
            continue
        members[0] = worst
        inside[worst] = attempt
        count = 1
        for walk in range(_WALKS):
            if count >= size:
                break
            robot = worst if 2 * walk < _WALKS else members[draw(random) % count]
            here, reached = paths[robot, 0], 0
            for step in range(steps - 1):
                first, degree = indptr[here], indptr[here + 1] - indptr[here]
                around = draw(random) % (degree + 1)
                there = here
                for index in range(degree):
                    node = neighbours[first + (index + around) % degree]
                    if reached < known and (
                        table[robot * known + reached, node] < table[robot * known + reached, here]
                    ):
                        there = node
                        break
                for when in range(2):
                    other = occupants[step + when, there]
                    if other >= 0 and inside[other] != attempt and count < size:
                        inside[other] = attempt
                        members[count] = other
                        count += 1
                if reached < known and there == goals[robot, reached]:
                    reached += 1
                here = there
        before, rest = 0, 0
        for index in range(count):
            other = draw(random) % (index + 1)
            robot = members[index]
            members[index] = members[other]
            members[other] = robot
        for index in range(count):
            robot = members[index]
            before += paid[robot]
            rest += _rest(table, base, goals, robot, 0, paths[robot, 0])
            old[index] = paths[robot]
            occupy(robot, paths, occupants, -1)
        total, planned = 0, 0
        while planned < count:
            robot = members[planned]
            rest -= _rest(table, base, goals, robot, 0, old[planned, 0])
            mark += 1
            cost = _search(
                indptr, neighbours, costs, table, base, goals, robot, old[planned, 0], before - total - rest,
                far, flags, paths, occupants, seen, mark, pool, heads, random,
            )  # fmt: skip
            if cost < 0:
                break
            total += cost
            fresh[planned] = cost
            occupy(robot, paths, occupants, robot)
            planned += 1
        arrives = limit
        if planned == count and inside[urgent] == attempt:
            arrives = _to_first_goal(indptr, neighbours, costs, table, goals, urgent, paths)
        if planned == count and arrives <= limit:
            limit = arrives
            better += 1 if total < before else 0
            for index in range(count):
                paid[members[index]] = fresh[index]
            continue
        for index in range(planned):
            occupy(members[index], paths, occupants, -1)
        for index in range(count):
            paths[members[index]] = old[index]
            occupy(members[index], paths, occupants, members[index])
    return better


_ROW, _TABLE = "int32[::1]", "int32[:, ::1]"
improve_window = kernel(
    f"int64({_ROW}, {_ROW}, {_ROW}, {_TABLE}, {_TABLE}, {_TABLE}, int64, int64, int64, int64, int64, int64, "
    f"{_TABLE}, {_ROW}, int64[::1])",
    numpy=_improve_window,
)(_improve_window)
