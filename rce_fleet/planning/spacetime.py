"""Search for one robot's path among the paths of others, over nodes and intervals of steps.

Each node has a list of its visits, and between them intervals in which it is free. The search is A* over
nodes and free intervals (Phillips and Likhachev, "SIPP: Safe Interval Path Planning for Dynamic
Environments", 2011), with the exact distances to the goal as heuristic. Estimates are whole numbers of steps
within a known range, so the open list is a row of stacks, and no operation on it costs more than a few
array accesses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper
from rce_fleet.planning.pibt import ROTATIONS
from rce_fleet.planning.swap import draw

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]


@helper
def occupant_at(step: int, node: int, counts: Ints, visits: Ints) -> int:
    """Return the robot that is in a node at a step, or -1."""
    for place in range(counts[node]):
        if visits[node, place, 1] >= step:
            return int(visits[node, place, 2]) if visits[node, place, 0] <= step else -1
    return -1


@helper
def add_visits(robot: int, path: Ints, counts: Ints, visits: Ints) -> None:
    """Enter a path into the lists of visits."""
    steps = len(path)
    enter = 0
    while enter < steps:
        node = path[enter]
        leave = enter
        while leave + 1 < steps and path[leave + 1] == node:
            leave += 1
        place = counts[node]
        while place > 0 and visits[node, place - 1, 0] > enter:
            for column in range(3):
                visits[node, place, column] = visits[node, place - 1, column]
            place -= 1
        visits[node, place, 0] = enter
        visits[node, place, 1] = leave
        visits[node, place, 2] = robot
        counts[node] += 1
        enter = leave + 1


@helper
def remove_visits(path: Ints, counts: Ints, visits: Ints) -> None:
    """Take a path out of the lists of visits."""
    steps = len(path)
    for enter in range(steps):
        node = path[enter]
        if enter > 0 and path[enter - 1] == node:
            continue
        place = 0
        while visits[node, place, 0] != enter:
            place += 1
        counts[node] -= 1
        for later in range(place, counts[node]):
            for column in range(3):
                visits[node, later, column] = visits[node, later + 1, column]


@helper
def is_free_entry(
    step: int, here: int, there: int, flags: int, paths: Ints, counts: Ints, visits: Ints
) -> bool:
    """Return whether a robot can leave ``here`` for ``there`` while another one enters ``here``."""
    other = occupant_at(step, there, counts, visits)
    for _ in range(len(paths)):
        if other < 0:
            break
        ahead = paths[other, step + 1]
        if ahead == here:
            return False
        if flags & ROTATIONS:
            break
        other = occupant_at(step, ahead, counts, visits)
    return True


@helper
def find_path(
    indptr: Ints,
    neighbours: Ints,
    field: Ints,
    start: int,
    goal: int,
    most: int,
    flags: int,
    paths: Ints,
    counts: Ints,
    visits: Ints,
    best: NDArray[np.int64],
    mark: int,
    pool: Ints,
    heads: Ints,
    random: NDArray[np.int64],
    path: Ints,
) -> int:
    """Write the earliest path into ``path``; return its arrival, or -1 if there is none up to ``most``.

    Args:
        indptr: The graph.
        neighbours: The graph.
        field: Distance to the goal, shape (nodes,).
        start: Node at step 0.
        goal: Node where the path ends; other robots' visits of it must be over.
        most: Latest arrival.
        flags: See :mod:`~rce_fleet.planning.pibt`.
        paths: Node of each robot at each step, shape (robots, steps).
        counts: Number of each node's visits, shape (nodes,).
        visits: First step, last step and robot of each visit, in order, shape (nodes, visits, 3).
        best: Mark of the search and earliest arrival in each interval, shape (nodes, visits).
        mark: Mark of this search; larger than those of earlier ones.
        pool: Scratch, shape (states, 5): node, interval, arrival, next in the stack, predecessor.
        heads: Scratch, shape (steps + 1,): top of each stack.
        random: State of the random numbers.
        path: Node at each step, shape (steps,); written.
    """
    steps = len(path)
    horizon = min(steps - 1, most)
    least = int(field[start])
    if counts[goal] > 0:
        least = max(least, visits[goal, counts[goal] - 1, 1] + 1)
    if least > horizon:
        return -1
    for level in range(horizon - least + 1):
        heads[level] = -1
    pool[0, 0], pool[0, 1], pool[0, 2], pool[0, 3], pool[0, 4] = start, 0, 0, -1, -1
    best[start, 0] = mark << 20
    heads[0] = 0
    used = 1
    level = 0
    while level <= horizon - least:
        entry = heads[level]
        if entry < 0:
            level += 1
            continue
        heads[level] = pool[entry, 3]
        here, interval, step = pool[entry, 0], pool[entry, 1], pool[entry, 2]
        if best[here, interval] != (mark << 20) + step:
            continue  # reached earlier meanwhile
        if here == goal and interval == counts[goal]:
            arrival = step
            for later in range(step, steps):
                path[later] = goal
            while pool[entry, 4] >= 0:
                entry = pool[entry, 4]
                for earlier in range(pool[entry, 2], step):
                    path[earlier] = pool[entry, 0]
                step = pool[entry, 2]
            return int(arrival)
        end = visits[here, interval, 0] - 1 if interval < counts[here] else steps - 1
        first = indptr[here]
        degree = indptr[here + 1] - first
        turn = draw(random) % degree if degree > 0 else 0
        for index in range(degree):
            there = neighbours[first + (index + turn) % degree]
            last = min(end + 1, horizon - field[there])
            count = counts[there]
            begin, place = 0, 0
            while place < count and visits[there, place, 0] <= step + 1:
                begin = visits[there, place, 1] + 1
                place += 1
            while begin <= last and used < len(pool):
                arrival = max(step + 1, begin)
                until = visits[there, place, 0] - 1 if place < count else steps - 1
                if (
                    arrival <= until
                    and arrival <= last
                    and not (best[there, place] >> 20 == mark and best[there, place] & 0xFFFFF <= arrival)
                    and (
                        arrival <= end
                        or is_free_entry(arrival - 1, here, there, flags, paths, counts, visits)
                    )
                ):
                    best[there, place] = (mark << 20) + arrival
                    estimate = max(arrival + field[there] - least, 0)
                    pool[used, 0], pool[used, 1], pool[used, 2] = there, place, arrival
                    pool[used, 3], pool[used, 4] = heads[estimate], entry
                    heads[estimate] = used
                    level = min(level, estimate)
                    used += 1
                if place >= count:
                    break
                begin = visits[there, place, 1] + 1
                place += 1
    return -1
