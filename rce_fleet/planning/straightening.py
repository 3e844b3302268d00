"""Cuts detours out of a joint plan: a robot waits in a node that it would leave and come back to.

PIBT moves robots that could stand still. If no other robot enters the node meanwhile, waiting in it blocks no
robot, so each such loop is replaced by waiting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]


def _straighten(cells: Ints, nodes: int, ends: Ints) -> int:
    """Cut loops until none is left.

    Args:
        cells: The plan, shape (steps, robots); changed.
        nodes: Number of nodes.
        ends: Until which step each robot's path counts, shape (robots,); loops that go on later stay.

    Returns:
        Number of loops that were cut.
    """
    steps, robots = cells.shape
    occupants = np.full((steps, nodes), -1, np.int32)
    for step in range(steps):
        for robot in range(robots):
            occupants[step, cells[step, robot]] = robot
    last = np.full(nodes, -1, np.int32)
    cuts, found = 0, 1
    while found > 0:
        found = 0
        for robot in range(robots):
            for step in range(steps):
                last[cells[step, robot]] = step
            step, end = 0, ends[robot]
            while step < end:
                node = cells[step, robot]
                back = min(last[node], end)
                until = step + 1  # the robot could stay until this step
                while until <= back and (occupants[until, node] == -1 or occupants[until, node] == robot):
                    until += 1
                until -= 1
                while until > step and cells[until, robot] != node:
                    until -= 1
                is_loop = False
                for between in range(step + 1, until):
                    if cells[between, robot] != node:
                        is_loop = True
                        occupants[between, cells[between, robot]] = -1
                        occupants[between, node] = robot
                        cells[between, robot] = node
                if is_loop:
                    found += 1
                step = max(until, step + 1)
        cuts += found
    return cuts


straighten = kernel("int64(int32[:, ::1], int64, int32[::1])", numpy=_straighten)(_straighten)


def ends_of(cells: Ints, goals: Ints, *, lifelong: bool) -> Ints:
    """Return until which step each robot's path counts, shape (robots,).

    Args:
        cells: The plan, shape (steps, robots).
        goals: Goal of each robot, shape (robots,).
        lifelong: Whether a path ends where the robot first reaches its goal; a robot that starts in it is
            only moved for the others, and its path ends with the plan.
    """
    ends = np.full(len(goals), len(cells) - 1, np.int32)
    if lifelong:
        there = cells == goals
        ends = np.where(there.any(axis=0) & ~there[0], np.argmax(there, axis=0), ends).astype(np.int32)
    return ends
