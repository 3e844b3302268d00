"""The loops of :mod:`rce_fleet.planning.path_improvement`.

Again and again a late robot and robots in its way lose their paths and are planned anew, one after another.
The new paths are kept if these robots arrive earlier in all, else they get their old ones back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.planning.swap import draw
from rce_fleet.planning.visit_search import STATE, search_path, write_distances
from rce_fleet.planning.visits import DWELL, ENTER, LEAVE, ROBOT, cut_path, enter_path, place_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

GROUP = 6
"""Most robots that are planned anew together."""
LEAST_GAIN = 1.0
"""So many steps earlier a group must arrive in all; less is not worth new paths."""
_LATER = 8.0
"""A robot arrives at most so many steps later than before, for the others' sake."""
_DRAWN = 4
"""Of so many robots the latest one is planned anew."""
_ATTEMPT = 10
"""What the choice of a group counts for, in states."""
STATES = 20_000
"""States of one search."""
_GIVE_UP = 4_000
"""States after which the search for one path gives up."""


@helper
def _look_up(
    robot: int,
    starts: Ints,
    goals: Ints,
    back_indptr: Ints,
    back_neighbours: Ints,
    closed_at: Ints,
    closed: Ints,
    fields: Ints,
    is_known: Ints,
    scratch: Ints,
) -> None:
    """Write the distances to a robot's goal, if they are not known yet."""
    if is_known[robot]:
        return
    is_known[robot] = 1
    goal = goals[robot]
    own_closed = closed[closed_at[robot] : closed_at[robot + 1]]
    write_distances(robot, starts, goals, back_indptr, back_neighbours, own_closed, fields[robot], scratch)
    goals[robot] = goal  # It has a path, so it can be reached.


@helper
def _find_group(
    first: int,
    begin: float,
    starts: Ints,
    indptr: Ints,
    neighbours: Ints,
    field: Ints,
    is_free: Ints,
    counts: Ints,
    times: Floats,
    tags: Ints,
    members: Ints,
    random: NDArray[np.int64],
) -> int:
    """Write a robot and those that it would meet on a shortest path into ``members``; return how many."""
    members[0] = first
    count, here, step, moved = 1, starts[first], begin, True
    while moved and count < len(members):
        for place in range(counts[here]):
            other = tags[here, place, ROBOT]
            if other < 0 or is_free[other] == 0 or count >= len(members):
                continue
            if times[here, place, ENTER] > step + 2.0 or times[here, place, LEAVE] < step - 1.0:
                continue
            is_known = False
            for index in range(count):
                is_known = is_known or members[index] == other
            if not is_known:
                members[count] = other
                count += 1
        edge, degree = indptr[here], indptr[here + 1] - indptr[here]
        turn = draw(random) % degree if degree else 0
        there, moved = here, False
        for index in range(degree):
            node = neighbours[edge + (index + turn) % degree]
            if field[node] < field[there]:
                there, moved = node, True
        here = there
        step += 1.0
    return count


def _improve_paths(
    indptr: Ints,
    neighbours: Ints,
    costs_at: Ints,
    costs: Ints,
    back_indptr: Ints,
    back_neighbours: Ints,
    directions: Ints,
    turns: Floats,
    starts: Ints,
    headings: Ints,
    begins: Floats,
    goals: Ints,
    closed_at: Ints,
    closed: Ints,
    clock: float,
    is_free: Ints,
    is_urgent: Ints,
    tries: int,
    effort: int,
    counts: Ints,
    times: Floats,
    tags: Ints,
    lengths: Ints,
    nodes: Ints,
    steps: Floats,
    fields: Ints,
    is_known: Ints,
    is_goal: Ints,
    best: Floats,
    marks: Ints,
    state: NDArray[np.int64],
    is_changed: Ints,
    random: NDArray[np.int64],
) -> float:
    """Plan groups of robots anew; see :func:`~rce_fleet.planning.path_improvement.improve_paths`.

    Args:
        indptr: The graph.
        neighbours: The graph.
        costs_at: Row of each robot in ``costs``, shape (robots,).
        costs: Steps that each edge takes at least, shape (rows, edges).
        back_indptr: The graph with reversed edges.
        back_neighbours: The graph with reversed edges.
        directions: Direction of each edge, shape (edges,).
        turns: Steps of turning from each heading to each direction, shape (5, 4).
        starts: Node of each robot, shape (robots,).
        headings: Heading of each robot there, shape (robots,).
        begins: Step at which it entered it, shape (robots,).
        goals: Goal of each robot, or -1, shape (robots,).
        closed_at: Where the closed nodes of each robot begin, shape (robots + 1,).
        closed: Nodes that a robot must not enter.
        clock: Step that the robots have reached, about.
        is_free: Whether a robot may have another path, shape (robots,).
        is_urgent: Whether it must not arrive later than before, shape (robots,).
        tries: Groups that are planned anew.
        effort: States of searches, of all calls, after which nothing more is tried.
        counts: Number of each node's visits, shape (nodes,); changed.
        times: Times of the visits, shape (nodes, room, 2); changed.
        tags: Robots of the visits, likewise; changed.
        lengths: Length of each robot's path, shape (robots,); changed.
        nodes: Nodes of the paths, shape (robots, longest); changed.
        steps: Steps of the paths, likewise; changed.
        fields: Distances to the goals, shape (robots, nodes); written where they are needed.
        is_known: Whether a robot's are written, shape (robots,); changed.
        is_goal: Whether a node is a robot's goal, shape (nodes,).
        best: Scratch, shape (nodes, room + 1, 5).
        marks: Scratch, shape (nodes, room + 1), zeros at first.
        state: Number of the last search, states so far, groups in vain since the last gain; changed.
        is_changed: Set to 1 for robots with another path, shape (robots,).
        random: State of the random numbers.

    Returns:
        By how many steps the robots arrive earlier, in all.
    """
    robots, longest = nodes.shape
    scratch = np.empty(len(counts), np.int32)
    states = np.empty((STATES, STATE), np.int32)
    scores = np.empty((STATES, 2))
    heap = np.empty(STATES, np.int32)
    members = np.empty(GROUP, np.int32)
    old_lengths = np.empty(GROUP, np.int32)
    old_nodes = np.empty((GROUP, longest), np.int32)
    old_steps = np.empty((GROUP, longest))
    work = np.zeros(1, np.int64)
    gain = 0.0
    for _ in range(tries):
        if state[1] >= effort:
            break
        state[1] += _ATTEMPT
        state[2] += 1
        worst, latest = -1, 0.0
        for _ in range(_DRAWN):
            robot = draw(random) % robots
            if is_free[robot] == 0:
                continue
            _look_up(
                robot, starts, goals, back_indptr, back_neighbours, closed_at, closed,
                fields, is_known, scratch,
            )  # fmt: skip
            late = steps[robot, lengths[robot] - 1] - max(begins[robot], clock) - fields[robot, starts[robot]]
            if late > latest:
                worst, latest = robot, late
        if worst < 0 or latest < LEAST_GAIN:
            continue
        count = _find_group(
            worst, max(begins[worst], clock), starts, indptr, neighbours, fields[worst], is_free, counts,
            times, tags, members, random,
        )  # fmt: skip
        if draw(random) % 2:  # In any order; else the late robot comes first.
            for index in range(count):
                other = draw(random) % (index + 1)
                members[index], members[other] = members[other], members[index]
        before, after = 0.0, 0.0
        for index in range(count):
            robot = members[index]
            length = lengths[robot]
            _look_up(
                robot, starts, goals, back_indptr, back_neighbours, closed_at, closed,
                fields, is_known, scratch,
            )  # fmt: skip
            old_lengths[index] = length
            old_nodes[index, :length], old_steps[index, :length] = (
                nodes[robot, :length],
                steps[robot, :length],
            )
            before += steps[robot, length - 1]
            cut_path(
                robot, starts[robot], begins[robot], nodes[robot, :length], steps[robot, :length], counts,
                times, tags,
            )  # fmt: skip
            lengths[robot] = 0
        planned = 0
        while planned < count:
            robot = members[planned]
            start, goal = starts[robot], goals[robot]
            own = place_of(robot, start, -np.inf, counts, times, tags)
            until = times[start, own + 1, ENTER] if own + 1 < counts[start] else np.inf
            begin = max(begins[robot], min(clock, until - 1.0))
            length = -1
            if begin < until:
                state[0] += 1
                work[0] = 0
                length = search_path(
                    indptr, neighbours, costs[costs_at[robot]], directions, turns, fields[robot], start,
                    headings[robot], begin, own, goal, DWELL, is_goal, _GIVE_UP, counts, times, tags, best,
                    marks, state[0], states, scores, heap, work, nodes[robot], steps[robot],
                )  # fmt: skip
                state[1] += work[0]
            if length < 1:
                break
            later = steps[robot, length - 1] - old_steps[planned, old_lengths[planned] - 1]
            after += steps[robot, length - 1]
            if later > (0.0 if is_urgent[robot] else _LATER) or after > before - LEAST_GAIN:
                break
            lengths[robot] = length
            if not enter_path(
                robot, start, goal, nodes[robot, :length], steps[robot, :length], counts, times, tags
            ):
                cut_path(
                    robot, start, begins[robot], nodes[robot, :length], steps[robot, :length], counts, times,
                    tags,
                )  # fmt: skip
                break
            planned += 1
        if planned == count:
            gain += before - after
            state[2] = 0
            for index in range(count):
                is_changed[members[index]] = 1
            continue
        for index in range(planned):
            robot = members[index]
            length = lengths[robot]
            cut_path(
                robot, starts[robot], begins[robot], nodes[robot, :length], steps[robot, :length], counts,
                times, tags,
            )  # fmt: skip
        for index in range(count):
            robot, length = members[index], old_lengths[index]
            lengths[robot] = length
            nodes[robot, :length], steps[robot, :length] = (
                old_nodes[index, :length],
                old_steps[index, :length],
            )
            enter_path(
                robot, starts[robot], goals[robot], nodes[robot, :length], steps[robot, :length], counts,
                times, tags,
            )  # fmt: skip
    return gain


_ROW, _TABLE, _FLOATS, _LONG = "int32[::1]", "int32[:, ::1]", "float64[::1]", "int64[::1]"
_GRAPHS = ", ".join([_ROW] * 3 + [_TABLE] + [_ROW] * 3 + ["float64[:, ::1]"])
_ROBOTS = f"{_ROW}, {_ROW}, {_FLOATS}, {_ROW}, {_ROW}, {_ROW}, float64, {_ROW}, {_ROW}, int64, int64"
_LISTS = f"{_ROW}, float64[:, :, ::1], int32[:, :, ::1]"
_PATHS = f"{_ROW}, {_TABLE}, float64[:, ::1], {_TABLE}, {_ROW}, {_ROW}, float64[:, :, ::1], {_TABLE}"
improve_paths = kernel(
    f"float64({_GRAPHS}, {_ROBOTS}, {_LISTS}, {_PATHS}, {_LONG}, {_ROW}, {_LONG})", numpy=_improve_paths
)(_improve_paths)
