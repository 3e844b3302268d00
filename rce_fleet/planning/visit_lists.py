"""The lists of visits (:mod:`rce_fleet.planning.visits`) of robots that have paths."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel
from rce_fleet.planning.visits import DWELL, ENTER, LEAVE, NEXT, ROBOT, add_visit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

_ADDED = 32
"""Visits that are added to a node later, at most."""


def list_visits(
    size: int,
    starts: Ints,
    goals: Ints,
    routes_at: Ints,
    nodes: Ints,
    steps: Floats,
    fixed: tuple[Ints, Floats],
) -> tuple[Ints, Floats, Ints]:
    """Return the visits of each node, in order.

    Args:
        size: Number of nodes.
        starts: Node in which each robot is, shape (robots,).
        goals: Goal of each robot, or -1, shape (robots,).
        routes_at: Where each robot's path begins, shape (robots + 1,).
        nodes: Nodes that the robots enter after their starts.
        steps: When they enter them.
        fixed: Visits of no robot, ``(node, step of leaving it)``; each was entered before all others.

    Returns:
        The number of each node's visits, their times and their tags. The memory of the last two is used again
        with the next call in the same thread.
    """
    counts = np.bincount(np.concatenate((starts, fixed[0], nodes)), minlength=size).astype(np.int32)
    room = int(counts.max(initial=0)) + _ADDED
    times, tags = _buffers.times(size, room), _buffers.tags(size, room)
    fill_lists(starts, goals, routes_at, nodes, steps, *fixed, counts, times, tags)
    return counts, times, tags


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


def _fill_numpy(
    starts: Ints,
    goals: Ints,
    routes_at: Ints,
    nodes: Ints,
    steps: Floats,
    others: Ints,
    others_leave: Floats,
    counts: Ints,
    times: Floats,
    tags: Ints,
) -> None:
    """Write the lists; see :func:`list_visits`."""
    count, total, size = len(starts), len(nodes), len(counts)
    first, last = routes_at[:-1], routes_at[1:]
    has_path = last > first
    leaves, ahead = np.full(total, np.inf), np.full(total, -1, np.int32)
    if total:
        leaves[:-1], ahead[:-1] = steps[1:], nodes[1:]
        ends = last[has_path] - 1
        is_rest = nodes[ends] == goals[has_path]
        leaves[ends], ahead[ends] = np.where(is_rest, steps[ends] + DWELL, np.inf), -1
    starts_leave, starts_ahead = np.full(count, np.inf), np.full(count, -1, np.int32)
    starts_leave[has_path] = steps[first[has_path]]
    starts_ahead[has_path] = nodes[first[has_path]]
    none = np.full(len(others), -1, np.int32)
    node = np.concatenate((starts, others, nodes))
    enter = np.concatenate((np.full(count + len(others), -np.inf), steps))
    leave = np.concatenate((starts_leave, others_leave, leaves))
    every = np.arange(count, dtype=np.int32)
    robot = np.concatenate((every, none, np.repeat(every, last - first)))
    following = np.concatenate((starts_ahead, none, ahead))
    order = np.lexsort((enter, node))
    node = node[order]
    begins = np.concatenate(([0], np.cumsum(np.bincount(node, minlength=size))[:-1]))
    place = np.arange(len(node)) - begins[node]
    enter, leave = enter[order], leave[order]
    is_followed = np.append(node[1:] == node[:-1], False) & (following[order] < 0) & (leave < np.inf)
    leave[:-1] = np.where(is_followed[:-1], np.minimum(leave[:-1], enter[1:]), leave[:-1])
    times[node, place, ENTER], times[node, place, LEAVE] = enter, leave
    tags[node, place, ROBOT], tags[node, place, NEXT] = robot[order], following[order]


def _fill(
    starts: Ints,
    goals: Ints,
    routes_at: Ints,
    nodes: Ints,
    steps: Floats,
    others: Ints,
    others_leave: Floats,
    counts: Ints,
    times: Floats,
    tags: Ints,
) -> None:
    """Write the lists; see :func:`list_visits`."""
    counts[:] = 0
    for index in range(len(others)):
        add_visit(-1, others[index], -np.inf, others_leave[index], -1, counts, times, tags)
    for robot in range(len(starts)):
        first, last = routes_at[robot], routes_at[robot + 1]
        leave, ahead = np.inf, -1
        if last > first:
            leave, ahead = steps[first], nodes[first]
        add_visit(robot, starts[robot], -np.inf, leave, ahead, counts, times, tags)
        for index in range(first, last):
            if index + 1 < last:
                leave, ahead = steps[index + 1], nodes[index + 1]
            else:
                leave, ahead = steps[index] + DWELL if nodes[index] == goals[robot] else np.inf, -1
            add_visit(robot, nodes[index], steps[index], leave, ahead, counts, times, tags)
    for node in range(len(counts)):
        for place in range(counts[node] - 1):
            if tags[node, place, NEXT] < 0 and times[node, place, LEAVE] < np.inf:
                times[node, place, LEAVE] = min(times[node, place, LEAVE], times[node, place + 1, ENTER])


_ROW, _TIMES, _LISTS = "int32[::1]", "float64[::1]", "float64[:, :, ::1], int32[:, :, ::1]"
fill_lists = kernel(
    f"void({_ROW}, {_ROW}, {_ROW}, {_ROW}, {_TIMES}, {_ROW}, {_TIMES}, {_ROW}, {_LISTS})",
    numpy=_fill_numpy,
)(_fill)
