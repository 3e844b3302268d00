"""The loops of :mod:`rce_fleet.planning.rerouting`.

The robots are planned one by one. Where one finds no path, the robots in its way lose theirs too: those that
it meets on its shortest path first. They are planned after it, and take their old paths again if these are
still possible. This is how large-neighbourhood search repairs a plan (Li et al., "MAPF-LNS2: Fast Repairing
for Multi-Agent Path Finding via Large Neighborhood Search", 2022), with neighbourhoods that grow as needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.planning.swap import draw
from rce_fleet.planning.visit_search import HEADINGS, STATE, search_path, write_distances
from rce_fleet.planning.visits import (
    DWELL,
    ENTER,
    FAR,
    LEAVE,
    ROBOT,
    cut_path,
    enter_path,
    fits_again,
    place_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

_STATES = 60_000
"""States of one search."""
_GIVE_UP = 12_000
"""States after which the search for one path gives up, and robots are taken out of its way. A longer search
costs less than new paths for robots that were not in the way."""
_ASIDE = 8
"""Most robots that are taken out of the way at once: one at first ..."""
_GROWS = 4
"""... and one more after so many turns, in which the same robots took each other out of the way."""
_TURNS = 40
"""Times that a robot is planned, and may take others out of its way."""
FREE, PLANNED, KEPT = -1, -2, -3
"""In place of a path's length: it has no path now, it was not looked at, it has its old path again."""


@helper
def _may_move(robot: int, lengths: Ints, slots: Ints, turns: Ints) -> bool:
    """Return whether a robot has a path that may be taken from it."""
    slot = slots[robot]
    return bool(slot < 0 or (lengths[slot] != FREE and turns[slot] < _TURNS))


@helper
def _note_once(robot: int, size: int, found: Ints) -> int:
    """Add a robot to a list of ``size`` robots unless it is in it; return the new size."""
    for index in range(size):
        if found[index] == robot:
            return size
    found[size] = robot
    return size + 1


@helper
def _find_standing(
    robot: int,
    start: int,
    indptr: Ints,
    neighbours: Ints,
    field: Ints,
    counts: Ints,
    times: Floats,
    tags: Ints,
    lengths: Ints,
    slots: Ints,
    turns: Ints,
    found: Ints,
) -> int:
    """Write the robots that stay on a robot's shortest path for good into ``found``; return how many.

    Such a visit need not be the last one of its node: others are due there once the robot has another goal.
    """
    here, size, moved = start, 0, True
    while moved and size < _ASIDE:
        for place in range(counts[here]):
            other = tags[here, place, ROBOT]
            is_standing = times[here, place, LEAVE] == np.inf and other >= 0 and other != robot
            if is_standing and size < _ASIDE and _may_move(other, lengths, slots, turns):
                size = _note_once(other, size, found)
        there, moved = here, False
        for edge in range(indptr[here], indptr[here + 1]):
            if field[neighbours[edge]] < field[there]:
                there, moved = neighbours[edge], True
        here = there
    return size


@helper
def _take_aside(
    robot: int,
    start: int,
    begin: float,
    goal: int,
    indptr: Ints,
    neighbours: Ints,
    field: Ints,
    counts: Ints,
    times: Floats,
    tags: Ints,
    lengths: Ints,
    slots: Ints,
    turns: Ints,
    found: Ints,
    random: NDArray[np.int64],
) -> int:
    """Write robots in the way of a robot on its shortest path into ``found``; return how many.

    Robots that stay in a node of it for good come first. Without these there may be no path at all: then each
    search is as long as it can be, and taking others aside does not help. Otherwise it is the first robots
    that it meets.
    """
    size = _find_standing(
        robot, start, indptr, neighbours, field, counts, times, tags, lengths, slots, turns, found
    )
    if size:
        return size
    here, step, moved = start, begin, True
    most = min(_ASIDE, 1 + turns[slots[robot]] // _GROWS)
    while moved and size < most:
        for place in range(counts[here]):
            other = tags[here, place, ROBOT]
            enter, leave = times[here, place, ENTER], times[here, place, LEAVE]
            is_near = enter <= step + 2.0 or here == goal
            if other < 0 or other == robot or not is_near or leave < step - 1.0:
                continue
            if size < most and _may_move(other, lengths, slots, turns):
                size = _note_once(other, size, found)
        first, degree = indptr[here], indptr[here + 1] - indptr[here]
        turn = draw(random) % degree if degree else 0
        there, moved = here, False
        for index in range(degree):
            node = neighbours[first + (index + turn) % degree]
            if field[node] < field[there] or (goal < 0 and here == start and field[node] < FAR):
                there, moved = node, True
        here = there
        step += 1.0
    return size


def _reroute(
    indptr: Ints,
    neighbours: Ints,
    costs_at: Ints,
    costs: Ints,
    back_indptr: Ints,
    back_neighbours: Ints,
    directions: Ints,
    turns_to: Floats,
    starts: Ints,
    headings: Ints,
    begins: Floats,
    goals: Ints,
    targets: Ints,
    closed_at: Ints,
    closed: Ints,
    routes_at: Ints,
    route_nodes: Ints,
    route_steps: Floats,
    clock: float,
    effort: int,
    members: Ints,
    counts: Ints,
    times: Floats,
    tags: Ints,
    slots: Ints,
    lengths: Ints,
    nodes: Ints,
    steps: Floats,
    random: NDArray[np.int64],
) -> bool:
    """Find new paths; see :func:`~rce_fleet.planning.rerouting.reroute`.

    Args:
        indptr: The graph.
        neighbours: The graph.
        costs_at: Row of each robot in ``costs``, shape (robots,).
        costs: Steps that each edge takes at least, shape (rows, edges).
        back_indptr: The graph with reversed edges.
        back_neighbours: The graph with reversed edges.
        directions: Direction of each edge, shape (edges,).
        turns_to: Steps of turning from each heading to each direction, shape (5, 4).
        starts: Node of each robot, shape (robots,).
        headings: Heading of each robot there, shape (robots,).
        begins: Step at which it entered it, shape (robots,).
        goals: Goal of each robot, or -1, shape (robots,).
        targets: Its goal or its place of rest, or -1; those that cannot be reached become -1.
        closed_at: Where the closed nodes of each robot begin, shape (robots + 1,).
        closed: Nodes that a robot must not enter.
        routes_at: Where each robot's path begins, shape (robots + 1,).
        route_nodes: Nodes that the robots enter after their starts.
        route_steps: When they enter them.
        clock: Step that the robots have reached, about.
        effort: States of searches that are expanded at most.
        members: Robots that need new paths, in order.
        counts: Number of each node's visits, shape (nodes,); changed.
        times: See :func:`~rce_fleet.planning.visits.search_path`; changed.
        tags: Likewise; robots of ``tags`` below 0 cannot be planned; changed.
        slots: Place of each robot in the next four, or -1, shape (robots,); written.
        lengths: Length of each new path, shape (touched,); written.
        nodes: Nodes of the new paths, shape (touched, longest); written.
        steps: Steps of the new paths, likewise; written.
        random: State of the random numbers.

    Returns:
        Whether all robots have a path.
    """
    size, room = len(counts), times.shape[1]
    touched = len(nodes)
    fields = np.empty((touched, size), np.int32)
    scratch = np.empty(size, np.int32)
    best = np.empty((size, room + 1, HEADINGS))
    marks = np.zeros((size, room + 1), np.int32)
    states = np.empty((_STATES, STATE), np.int32)
    scores = np.empty((_STATES, 2))
    heap = np.empty(_STATES, np.int32)
    turns = np.zeros(touched, np.int32)
    robots = np.empty(touched, np.int32)
    is_goal = np.zeros(size, np.int32)
    found = np.empty(_ASIDE, np.int32)
    waiting = np.empty(touched, np.int32)
    for goal in goals:
        if goal >= 0:
            is_goal[goal] = 1
    work = np.zeros(1, np.int64)
    used, left, mark = 0, 0, 0
    for index in range(len(members) - 1, -1, -1):
        robot = members[index]
        slots[robot], robots[used], lengths[used] = used, robot, FREE
        first, last = routes_at[robot], routes_at[robot + 1]
        cut_path(
            robot, starts[robot], begins[robot], route_nodes[first:last], route_steps[first:last],
            counts, times, tags,
        )  # fmt: skip
        own_closed = closed[closed_at[robot] : closed_at[robot + 1]]
        write_distances(
            robot, starts, targets, back_indptr, back_neighbours, own_closed, fields[used], scratch
        )
        waiting[left] = used
        used += 1
        left += 1
    asked = left
    while left > 0:
        left -= 1
        slot = waiting[left]
        robot = robots[slot]
        start, goal, target = starts[robot], goals[robot], targets[robot]
        first, last = routes_at[robot], routes_at[robot + 1]
        if slot >= asked and fits_again(
            robot, start, goal, route_nodes[first:last], route_steps[first:last], slots, fields[slot],
            counts, times, tags,
        ):  # fmt: skip
            lengths[slot] = KEPT
            if not enter_path(
                robot, start, goal, route_nodes[first:last], route_steps[first:last], counts, times, tags
            ):
                return False
            continue
        own = place_of(robot, start, -np.inf, counts, times, tags)
        until = times[start, own + 1, ENTER] if own + 1 < counts[start] else np.inf
        begin = max(begins[robot], min(clock, until - 1.0))
        length = -1
        can_stay = back_indptr[start] < back_indptr[start + 1] and fields[slot, start] < FAR
        if target < 0 and until == np.inf and can_stay:
            length = 0
        elif begin < until:
            mark += 1
            dwell = DWELL if goal >= 0 and target == goal else np.inf
            most = min(_GIVE_UP, effort - work[0])
            length = search_path(
                indptr, neighbours, costs[costs_at[robot]], directions, turns_to, fields[slot], start,
                headings[robot], begin, own, target, dwell, is_goal, most, counts, times, tags, best, marks,
                mark, states, scores, heap, work, nodes[slot], steps[slot],
            )  # fmt: skip
        if length >= 0:
            lengths[slot] = length
            if not enter_path(
                robot, start, goal, nodes[slot, :length], steps[slot, :length], counts, times, tags
            ):
                return False
            continue
        turns[slot] += 1
        others = _take_aside(
            robot, start, begin, target, indptr, neighbours, fields[slot], counts, times, tags,
            lengths, slots, turns, found, random,
        )  # fmt: skip
        if others == 0 or turns[slot] > _TURNS or work[0] >= effort or used + others > touched:
            return False
        for index in range(others):
            other = found[index]
            first, last = routes_at[other], routes_at[other + 1]
            mine = slots[other]
            if mine >= 0 and lengths[mine] >= 0:
                there = lengths[mine]
                cut_path(
                    other, starts[other], begins[other], nodes[mine, :there], steps[mine, :there],
                    counts, times, tags,
                )  # fmt: skip
            else:
                cut_path(
                    other, starts[other], begins[other], route_nodes[first:last], route_steps[first:last],
                    counts, times, tags,
                )  # fmt: skip
            if mine < 0:
                mine = used
                used += 1
                slots[other], robots[mine] = mine, other
                own_closed = closed[closed_at[other] : closed_at[other + 1]]
                write_distances(
                    other, starts, targets, back_indptr, back_neighbours, own_closed, fields[mine], scratch
                )
            lengths[mine] = FREE
            waiting[left] = mine
            left += 1
        waiting[left] = slot
        left += 1
    return True


_ROW, _TABLE, _TIMES = "int32[::1]", "int32[:, ::1]", "float64[::1]"
_GRAPHS, _ROBOTS = (
    ", ".join([_ROW] * 3 + [_TABLE] + [_ROW] * 3 + ["float64[:, ::1]"]),
    f"{_ROW}, {_ROW}, {_TIMES}, {_ROW}, {_ROW}, {_ROW}, {_ROW}",
)
_SEARCH = f"float64, int64, {_ROW}"
_LISTS = f"{_ROW}, float64[:, :, ::1], int32[:, :, ::1]"
reroute_robots = kernel(
    f"boolean({_GRAPHS}, {_ROBOTS}, {_ROW}, {_ROW}, {_TIMES}, {_SEARCH}, {_LISTS}, {_ROW}, {_ROW}, {_TABLE}, "
    "float64[:, ::1], int64[::1])",
    numpy=_reroute,
)(_reroute)
