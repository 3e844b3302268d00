"""Visits of nodes by many robots, in lists that compiled loops read and change.

A visit lasts from the step at which a robot enters a node to the step at which it enters the next one. Each
node has a list of its visits in order; between them are intervals in which it is free. Steps only say who
comes first (see :mod:`rce_fleet.coordination.ledger`), so they need not be whole numbers. A robot may enter a
node at the step at which another leaves it, unless that would close a circle of robots that all wait for
their next node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]

ENTER, LEAVE = 0, 1
"""Columns of a visit's times."""
ROBOT, NEXT = 0, 1
"""Columns of a visit's tags: the robot, and the node that it enters next, or -1."""
FAR = 1 << 30
"""A distance that means that there is no path."""
DWELL = 4.0
"""So many steps a robot is in its goal; then it soon has another goal, and the others wait for that."""


@helper
def place_of(robot: int, node: int, enter: float, counts: Ints, times: Floats, tags: Ints) -> int:
    """Return the place of a robot's visit in the list of a node, or -1."""
    for place in range(counts[node]):
        if tags[node, place, ROBOT] == robot and times[node, place, ENTER] == enter:
            return place
    return -1


@helper
def end_of_rest(enter: float, node: int, goal: int, counts: Ints, times: Floats) -> float:
    """Return the step at which a robot that ends in ``node`` leaves it: soon, if that is its goal."""
    if node != goal:
        return float(np.inf)
    leave = enter + DWELL
    for place in range(counts[node]):
        if times[node, place, ENTER] > enter:
            return float(min(leave, times[node, place, ENTER]))
    return leave


@helper
def add_visit(
    robot: int, node: int, enter: float, leave: float, ahead: int, counts: Ints, times: Floats, tags: Ints
) -> bool:
    """Add a visit to the list of a node; return whether the list has room for it."""
    place = counts[node]
    if place >= times.shape[1]:
        return False
    while place > 0 and times[node, place - 1, ENTER] > enter:
        for column in range(2):
            times[node, place, column] = times[node, place - 1, column]
            tags[node, place, column] = tags[node, place - 1, column]
        place -= 1
    times[node, place, ENTER], times[node, place, LEAVE] = enter, leave
    tags[node, place, ROBOT], tags[node, place, NEXT] = robot, ahead
    counts[node] += 1
    return True


@helper
def drop_visit(node: int, place: int, counts: Ints, times: Floats, tags: Ints) -> None:
    """Remove a visit from the list of a node."""
    counts[node] -= 1
    for later in range(place, counts[node]):
        for column in range(2):
            times[node, later, column] = times[node, later + 1, column]
            tags[node, later, column] = tags[node, later + 1, column]


@helper
def closes_circle(step: float, here: int, there: int, counts: Ints, times: Floats, tags: Ints) -> bool:
    """Return whether robots that all move at one step would follow one another around in a circle.

    Args:
        step: When a robot leaves ``here`` for ``there``.
        here: Node that is left.
        there: Node that is entered.
        counts: Number of each node's visits.
        times: Times of the visits.
        tags: Robots of the visits.
    """
    node = there
    for _ in range(len(counts)):
        ahead = -1
        for place in range(counts[node]):
            if times[node, place, LEAVE] == step:
                ahead = tags[node, place, NEXT]
        if ahead < 0:
            return False
        if ahead == here:
            return True
        node = ahead
    return True


@helper
def cut_path(
    robot: int, start: int, step: float, nodes: Ints, steps: Floats, counts: Ints, times: Floats, tags: Ints
) -> None:
    """Take a robot's path out of the lists; it may leave its start soon after it entered it."""
    for index in range(len(nodes)):
        place = place_of(robot, nodes[index], steps[index], counts, times, tags)
        if place >= 0:
            drop_visit(nodes[index], place, counts, times, tags)
    own = place_of(robot, start, -np.inf, counts, times, tags)
    until = times[start, own + 1, ENTER] if own + 1 < counts[start] else np.inf
    times[start, own, LEAVE], tags[start, own, NEXT] = step + min(0.5, (until - step) / 2), -1


@helper
def enter_path(
    robot: int, start: int, goal: int, nodes: Ints, steps: Floats, counts: Ints, times: Floats, tags: Ints
) -> bool:
    """Enter a robot's path into the lists; return whether they have room."""
    own = place_of(robot, start, -np.inf, counts, times, tags)
    times[start, own, LEAVE] = steps[0] if len(nodes) else np.inf
    tags[start, own, NEXT] = nodes[0] if len(nodes) else -1
    for index in range(len(nodes)):
        is_last = index + 1 == len(nodes)
        leave = end_of_rest(steps[index], nodes[index], goal, counts, times)
        ahead = -1
        if not is_last:
            leave, ahead = steps[index + 1], nodes[index + 1]
        if not add_visit(robot, nodes[index], steps[index], leave, ahead, counts, times, tags):
            return False
    return True


@helper
def fits_again(
    robot: int,
    start: int,
    goal: int,
    nodes: Ints,
    steps: Floats,
    slots: Ints,
    field: Ints,
    counts: Ints,
    times: Floats,
    tags: Ints,
) -> bool:
    """Return whether a robot can have its old path again: no robot with a new path is in its way."""
    own = place_of(robot, start, -np.inf, counts, times, tags)
    here = start
    for index in range(-1, len(nodes)):
        node = start if index < 0 else nodes[index]
        leave = np.inf
        if index + 1 < len(nodes):
            leave = steps[index + 1]
        elif index >= 0:
            leave = end_of_rest(steps[index], node, goal, counts, times)
        if index < 0:
            place = own + 1
        else:
            step = steps[index]
            if field[node] >= FAR:
                return False
            place = 0
            while place < counts[node] and times[node, place, ENTER] < step:
                place += 1
            for before in range(place):
                other = tags[node, before, ROBOT]
                if (other < 0 or slots[other] >= 0) and times[node, before, LEAVE] > step:
                    return False
                if times[node, before, LEAVE] == step and closes_circle(
                    step, here, node, counts, times, tags
                ):
                    return False
        if place < counts[node] and times[node, place, ENTER] < leave:
            other = tags[node, place, ROBOT]
            if slots[other] >= 0:
                return False
        here = node
    return True
