"""How long robots need to carry out a joint plan.

A robot enters a cell when the one before it in the plan has left, and not before it has turned; nothing else
keeps it. So robots keep the plan's order, but not its steps (Hoenig et al., "Persistent and Robust Execution
of MAPF Schedules in Warehouses", 2019: the action dependency graph).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel
from rce_fleet.planning.guidance import DOWN, LEFT, RIGHT, UP
from rce_fleet.planning.motion import QUARTERS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.planning.motion import Motion

    Ints = NDArray[np.int32]
    Floats = NDArray[np.float64]


def _execute(cells: Ints, columns: int, lost: Floats, stop: float, headings: Ints, ends: Floats) -> None:
    """Write the time at which each robot ends.

    Args:
        cells: The plan, shape (steps + 1, robots).
        columns: Columns of the grid.
        lost: Time of turning from each heading to each direction, steps, shape (5, 4).
        stop: Time lost by stopping and starting, steps.
        headings: Heading of each robot, shape (robots,); changed.
        ends: End of each robot's last move, steps, shape (robots,); zeros, written.
    """
    steps, robots = cells.shape
    nodes = 0
    for step in range(steps):
        for robot in range(robots):
            nodes = max(nodes, cells[step, robot] + 1)
    left = np.zeros(nodes)
    occupant = np.full(nodes, -1, np.int32)
    is_still = np.ones(robots, np.int32)
    done = np.zeros(robots, np.int32)
    stack = np.zeros(robots, np.int32)
    for robot in range(robots):
        occupant[cells[0, robot]] = robot
    for step in range(1, steps):
        for first in range(robots):
            # A robot that enters a cell follows the one that leaves it in the same step.
            depth, robot = 0, first
            while robot >= 0 and done[robot] != step and cells[step, robot] != cells[step - 1, robot]:
                stack[depth] = robot
                depth += 1
                done[robot] = step
                robot = occupant[cells[step, robot]]
            while depth > 0:
                depth -= 1
                robot = stack[depth]
                here, there = cells[step - 1, robot], cells[step, robot]
                offset = there - here
                direction = LEFT
                if offset == columns:
                    direction = UP
                elif offset == -columns:
                    direction = DOWN
                elif offset == 1:
                    direction = RIGHT
                turned = ends[robot] + lost[headings[robot], direction]
                begin = max(turned, left[there])
                if begin > ends[robot] or is_still[robot]:
                    begin += stop
                ends[robot] = begin + 1.0
                left[here] = ends[robot]
                headings[robot] = direction
                is_still[robot] = 0
        for robot in range(robots):
            occupant[cells[step - 1, robot]] = -1
        for robot in range(robots):
            occupant[cells[step, robot]] = robot


execute = kernel(
    "void(int32[:, ::1], int64, float64[:, ::1], float64, int32[::1], float64[::1])", numpy=_execute
)(_execute)


def execution_times(cells: Ints, columns: int, motion: Motion) -> Floats:
    """Return the time at which each robot ends its last move, in steps, shape (robots,).

    Robots that follow one another around in a circle are taken to start one after another.

    Args:
        cells: The plan, numbered as in the grid, shape (steps + 1, robots).
        columns: Columns of the grid.
        motion: What turning and stopping cost. The first move of a robot begins with a stop.
    """
    robots = cells.shape[1]
    ends = np.zeros(robots)
    headings = np.array([motion.heading(robot) for robot in range(robots)], np.int32)
    lost = QUARTERS.astype(np.float64) * motion.quarter_turn
    execute(np.ascontiguousarray(cells), columns, lost, motion.stop, headings, ends)
    return ends
