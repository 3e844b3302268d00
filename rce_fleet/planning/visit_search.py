"""Search for one robot's path between the visits of the others; see :mod:`rce_fleet.planning.visits`.

The search is A* over nodes and free intervals (Phillips and Likhachev, "SIPP: Safe Interval Path Planning for
Dynamic Environments", 2011) with the exact distances to the goal as heuristic.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper
from rce_fleet.planning.visits import ENTER, FAR, LEAVE, closes_circle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

_WEIGHT = 1.25
"""A path takes at most so many times the steps of the shortest one that is possible; this is found sooner."""
CELL, PLACE, PARENT, FACING = 0, 1, 2, 3
"""Columns of a state of the search: node, number of its interval, state before it, heading."""
STATE, HEADINGS = 4, 5
"""Columns of a state; headings, with the unknown one (see ``motion``)."""


@helper
def write_distances(
    robot: int,
    starts: Ints,
    goals: Ints,
    indptr: Ints,
    neighbours: Ints,
    closed: Ints,
    field: Ints,
    queue: Ints,
) -> None:
    """Write the number of moves to a robot's goal from each node; all 0 without a goal.

    A robot that cannot reach its goal has none from now on.

    Args:
        robot: The robot.
        starts: Node of each robot.
        goals: Goal of each robot, or -1; changed.
        indptr: The reversed graph.
        neighbours: The reversed graph.
        closed: Nodes that must not be entered.
        field: Written.
        queue: Scratch, shape (nodes,).
    """
    goal, start = goals[robot], starts[robot]
    if goal >= 0:
        field[:] = FAR
        for node in closed:
            if node != start:
                field[node] = -1  # It is not entered; the robot may leave its start.
        queue[0], first, last = goal, 0, 0
        if field[goal] == FAR and (goal == start or indptr[goal] < indptr[goal + 1]):
            field[goal], last = 0, 1
        while first < last:
            here = queue[first]
            first += 1
            for edge in range(indptr[here], indptr[here + 1]):
                there = neighbours[edge]
                if field[there] == FAR:
                    field[there] = field[here] + 1
                    queue[last] = there
                    last += 1
        if field[start] >= FAR:
            goals[robot] = goal = -1
    if goal < 0:
        field[:] = 0
    for node in closed:
        if goal < 0 or node != start:
            field[node] = FAR


@helper
def _is_before(a: int, b: int, scores: Floats) -> bool:
    """Return whether state ``a`` is to be expanded before ``b``: less in all, or as much and nearer."""
    if scores[a, 1] != scores[b, 1]:
        return bool(scores[a, 1] < scores[b, 1])
    return bool(scores[a, 0] > scores[b, 0])


@helper
def _push(state: int, size: int, heap: Ints, scores: Floats) -> None:
    """Add a state to a heap of ``size`` states."""
    place = size
    while place > 0:
        above = (place - 1) // 2
        if not _is_before(state, heap[above], scores):
            break
        heap[place] = heap[above]
        place = above
    heap[place] = state


@helper
def _pop(size: int, heap: Ints, scores: Floats) -> int:
    """Remove the first state of a heap of ``size`` states, and return it."""
    first, last = heap[0], heap[size - 1]
    place = 0
    while True:
        below = 2 * place + 1
        if below >= size - 1:
            break
        if below + 1 < size - 1 and _is_before(heap[below + 1], heap[below], scores):
            below += 1
        if not _is_before(heap[below], last, scores):
            break
        heap[place] = heap[below]
        place = below
    heap[place] = last
    return int(first)


@helper
def _is_reached(arrival: float, heading: int, best: Floats, turns: Floats) -> bool:
    """Return whether a robot can be in a node, and have turned to a heading, as early by another way."""
    for other in range(4):
        if best[other] + turns[other, heading] <= arrival:
            return True
    return bool(best[4] <= arrival)


@helper
def search_path(
    indptr: Ints,
    neighbours: Ints,
    costs: Ints,
    directions: Ints,
    turns: Floats,
    field: Ints,
    start: int,
    facing: int,
    begin: float,
    own: int,
    goal: int,
    dwell: float,
    is_goal: Ints,
    most: int,
    counts: Ints,
    times: Floats,
    tags: Ints,
    best: Floats,
    marks: Ints,
    mark: int,
    states: Ints,
    scores: Floats,
    heap: Ints,
    work: NDArray[np.int64],
    nodes: Ints,
    steps: Floats,
) -> int:
    """Write an early path into ``nodes`` and ``steps``; return its length, or -1 if none was found.

    Args:
        indptr: The graph.
        neighbours: The graph.
        costs: Steps that each edge takes at least.
        directions: Direction of each edge.
        turns: Steps of turning from each heading to each direction, shape (5, 4).
        field: Distance to the goal, shape (nodes,); zeros without a goal.
        start: Node in which the robot is.
        facing: Its heading.
        begin: Earliest step at which it leaves.
        own: Place of its visit of ``start``.
        goal: Node where the path ends; -1: any node that no robot has as goal and none enters later.
        dwell: So many steps it must have there before the next robot is due.
        is_goal: Whether a node is a robot's goal.
        most: States that are expanded at most.
        counts: Number of each node's visits, shape (nodes,).
        times: Steps of entering and leaving, shape (nodes, visits, 2).
        tags: Robot and next node of each visit, shape (nodes, visits, 2).
        best: Scratch, shape (nodes, visits + 1, 5): earliest arrival in each interval, by heading.
        marks: Scratch, shape (nodes, visits + 1): search that ``best`` is of.
        mark: Number of this search.
        states: Scratch, shape (states, 4): node, interval, state before, heading.
        scores: Scratch, shape (states, 2): arrival, arrival with what is left.
        heap: Scratch, shape (states,).
        work: The number of expanded states is added to it, shape (1,).
        nodes: Nodes to enter; written.
        steps: When to enter them; written.
    """
    states[0, CELL], states[0, PLACE], states[0, PARENT], states[0, FACING] = start, own + 1, -1, facing
    scores[0, 0], scores[0, 1] = begin, begin + _WEIGHT * field[start]
    best[start, own + 1, :] = np.inf
    best[start, own + 1, facing], marks[start, own + 1] = begin, mark
    heap[0] = 0
    size, used, expanded = 1, 1, 0
    chosen = -1
    while size > 0 and expanded < most:
        state = _pop(size, heap, scores)
        size -= 1
        here, interval, step = states[state, CELL], states[state, PLACE], scores[state, 0]
        heading = states[state, FACING]
        if step > best[here, interval, heading]:
            continue  # reached earlier meanwhile
        until = times[here, interval, ENTER] if interval < counts[here] else np.inf
        is_aside = goal < 0 and state > 0 and not is_goal[here] and until == np.inf
        if is_aside or (here == goal and until - step >= (dwell if state > 0 else np.inf)):
            chosen = state
            break
        expanded += 1
        work[0] += 1
        for edge in range(indptr[here], indptr[here + 1]):
            there = neighbours[edge]
            if field[there] >= FAR:
                continue
            ahead = directions[edge]
            pace = costs[edge] + turns[heading, ahead]
            if state == 0:
                pace = min(pace, until - step)  # It may have to give way at once.
            after, first = -np.inf, 0
            while first < counts[there] and times[there, first, ENTER] <= step + pace:
                after = max(after, times[there, first, LEAVE])  # the interval before is over by then
                first += 1
            for place in range(first, counts[there] + 1):
                if place > first:
                    after = max(after, times[there, place - 1, LEAVE])
                if after > until or after == np.inf:
                    break
                before = times[there, place, ENTER] if place < counts[there] else np.inf
                arrival = max(step + pace, after)
                if arrival >= before or arrival > until or arrival <= step:
                    continue
                if marks[there, place] == mark and _is_reached(arrival, ahead, best[there, place], turns):
                    continue
                if arrival == after and closes_circle(arrival, here, there, counts, times, tags):
                    arrival = after + min(0.5, (before - after) / 2)
                    if arrival > until or arrival >= before:
                        continue
                    if marks[there, place] == mark and _is_reached(arrival, ahead, best[there, place], turns):
                        continue
                if used >= len(states):
                    return -1
                if marks[there, place] != mark:
                    best[there, place, :] = np.inf
                    marks[there, place] = mark
                best[there, place, ahead] = arrival
                states[used, CELL], states[used, PLACE], states[used, PARENT] = there, place, state
                states[used, FACING] = ahead
                scores[used, 0], scores[used, 1] = arrival, arrival + _WEIGHT * field[there]
                _push(used, size, heap, scores)
                size += 1
                used += 1
    if chosen < 0:
        return -1
    length, state = 0, chosen
    while states[state, PARENT] >= 0:
        length += 1
        state = states[state, PARENT]
    if length > len(nodes):
        return -1
    state = chosen
    for index in range(length - 1, -1, -1):
        nodes[index], steps[index] = states[state, CELL], scores[state, 0]
        state = states[state, PARENT]
    return length
