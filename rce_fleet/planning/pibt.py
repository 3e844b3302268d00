"""PIBT with swap: the next node of every robot, by priority inheritance with backtracking.

After Okumura et al., "Priority Inheritance with Backtracking for Iterative Multi-agent Path Finding" (2022),
with the swap rule of ``swap``. Equally near nodes are taken in random order: with any fixed preference among
them, also one for empty nodes or for those where few others are hindered, robots in dense maps repeat
their moves without end.

If rotations are not allowed, robots may follow one another, but not around in a circle: a robot that enters a
node only when it has been left would wait there for itself.

The loops use explicit stacks. They run as they are when numba is not installed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.planning.motion import UNITS
from rce_fleet.planning.swap import OPEN, draw, swap_partner

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Table = NDArray[np.int16] | NDArray[np.int32]

_PUSHED = 2
ROTATIONS = 1
"""Flag: robots may follow one another around in a circle."""
FAR_AIM = 2**30
"""Cost to the goal of a robot that can only stay."""


@helper
def _closes_circle(now: Ints, after: Ints, occupant: Ints, robot: int, node: int) -> bool:
    """Return whether robots would follow one another around if ``robot`` entered ``node``."""
    ahead = occupant[node]
    while ahead >= 0 and ahead != robot and after[ahead] != OPEN and after[ahead] != now[ahead]:
        if after[ahead] == now[robot]:
            return True
        ahead = occupant[after[ahead]]
    return False


@helper
def _has_edge(indptr: Ints, neighbours: Ints, start: int, end: int) -> bool:
    """Return whether an edge leads from one node to another: a partner is not pulled against a direction."""
    edge = indptr[start]
    while edge < indptr[start + 1] and neighbours[edge] != end:
        edge += 1
    return bool(edge < indptr[start + 1])


@helper
def _choices(
    indptr: Ints,
    neighbours: Ints,
    table: Table,
    far: int,
    robot: int,
    here: int,
    facing: Ints,
    turning: Ints,
    aims: Ints,
    directions: Ints,
    turns: Ints,
    random: NDArray[np.int64],
    keys: NDArray[np.int64],
    found: Ints,
) -> int:
    """Write the nodes that ``robot`` can be in next into ``found``, the best first; return their number."""
    noise = draw(random)
    count = 0
    is_turning = turning[robot] > 0 and table[robot, here] > 0
    nearest = np.int64(FAR_AIM)
    for edge in range(indptr[here], indptr[here + 1] + 1):
        node = neighbours[edge] if edge < indptr[here + 1] else here
        away = table[robot, node]
        if away >= far and node != here:
            continue
        noise = (noise * 1103515245 + 12345) & 0x7FFFFFFF
        if is_turning:
            if node == here:
                away = nearest + UNITS  # a step later, from the same place
            else:
                away = aims[robot, edge] + turns[facing[robot], directions[edge]]
                nearest = min(nearest, np.int64(away))
        key = np.int64(away) * 4096 + (noise >> 16 & 4095)
        place = count
        while place > 0 and keys[place - 1] > key:
            keys[place] = keys[place - 1]
            found[place] = found[place - 1]
            place -= 1
        keys[place] = key
        found[place] = node
        count += 1
    return count


@helper
def _next_nodes(
    indptr: Ints,
    neighbours: Ints,
    table: Table,
    far: int,
    goals: Ints,
    now: Ints,
    after: Ints,
    order: Ints,
    occupant: Ints,
    taken: Ints,
    flags: int,
    facing: Ints,
    turning: Ints,
    aims: Ints,
    directions: Ints,
    turns: Ints,
    random: NDArray[np.int64],
    keys: NDArray[np.int64],
    stack: Ints,
    found: Ints,
) -> bool:
    """Fill ``after``, in which some nodes may be given; return whether all robots have one.

    ``occupant`` and ``taken`` are the robots in each node now and in the next step. ``stack`` has a row for
    each robot that is pushed: robot, number of choices, next choice, swap partner; ``found`` has its choices.
    """
    for place in range(len(order)):
        if after[order[place]] != OPEN:
            continue
        depth = 0
        stack[0, 0] = order[place]
        stack[0, 2] = -1
        while depth >= 0:
            robot = stack[depth, 0]
            here = now[robot]
            if stack[depth, 2] < 0:
                count = _choices(
                    indptr, neighbours, table, far, robot, here, facing, turning, aims, directions, turns,
                    random, keys, found[depth],
                )  # fmt: skip
                partner = swap_partner(
                    indptr, neighbours, table, goals, now, after, occupant, robot, found[depth, 0]
                )
                if partner >= 0:
                    for index in range(count // 2):
                        node = found[depth, index]
                        found[depth, index] = found[depth, count - 1 - index]
                        found[depth, count - 1 - index] = node
                stack[depth, 1] = count
                stack[depth, 2] = 0
                stack[depth, 3] = partner
            count = stack[depth, 1]
            choice = stack[depth, 2]
            outcome = 0  # no choice left; 1: chosen; or another robot has to move first
            while choice < count and outcome == 0:
                node = found[depth, choice]
                choice += 1
                if taken[node] >= 0:
                    continue
                other = occupant[node]
                if other >= 0 and other != robot:
                    if after[other] == here:
                        continue
                    if flags & ROTATIONS == 0 and _closes_circle(now, after, occupant, robot, node):
                        continue
                taken[node] = robot
                after[robot] = node
                outcome = _PUSHED if other >= 0 and other != robot and after[other] == OPEN else 1
            stack[depth, 2] = choice
            if outcome == _PUSHED:
                depth += 1
                stack[depth, 0] = other
                stack[depth, 2] = -1
                continue
            if outcome == 0:
                after[robot] = here
                taken[here] = robot
                depth -= 1
                if depth < 0:
                    return False
                continue  # the robot that pushed this one tries its next choice
            while depth >= 0:  # this robot and all that pushed it have their nodes
                robot = stack[depth, 0]
                partner = stack[depth, 3]
                here = now[robot]
                is_open = partner >= 0 and after[partner] == OPEN and taken[here] < 0
                is_open = is_open and table[partner, here] < far  # else it must not enter that node
                if is_open and stack[depth, 2] == 1 and _has_edge(indptr, neighbours, now[partner], here):
                    after[partner] = here
                    taken[here] = partner
                depth -= 1
    return True


@helper
def _is_valid(now: Ints, after: Ints, occupant: Ints, flags: int) -> bool:
    """Return whether no robots change places or, if that is not allowed, follow around in a circle."""
    for robot in range(len(now)):
        if after[robot] == now[robot]:
            continue
        other = occupant[after[robot]]
        if other >= 0 and other != robot and after[other] == now[robot]:
            return False
        if flags & ROTATIONS == 0 and _closes_circle(now, after, occupant, robot, after[robot]):
            return False
    return True


def _roll_out(
    indptr: Ints,
    neighbours: Ints,
    table: Table,
    far: int,
    goals: Ints,
    fixed: Ints,
    rows: Ints,
    urgency: Ints,
    order: Ints,
    flags: int,
    facing: Ints,
    turning: Ints,
    aims: Ints,
    directions: Ints,
    turns: Ints,
    random: NDArray[np.int64],
) -> int:
    """Make configurations one after another until all robots are at their goals.

    Args:
        indptr: The graph, see :class:`~rce_fleet.planning.graph.PlanningGraph`.
        neighbours: The graph.
        table: Distance of each robot to its goal, shape (robots, nodes).
        far: Distances from here on mean that no path exists.
        goals: Goal of each robot, shape (robots,).
        fixed: Nodes that are given for the first step, or ``OPEN``, shape (robots,).
        rows: Configurations, shape (steps + 1, robots); row 0 is given, the others are written.
        urgency: For each row the steps since each robot was at its goal last, shape (steps + 1, robots).
        order: Robots, the most urgent first; kept in order.
        flags: ``ROTATIONS`` or 0.
        facing: For each row the heading of each robot, shape (steps + 1, robots); row 0 is given.
        turning: 1 for robots that choose by turns, shape (robots,); see
            :class:`~rce_fleet.planning.motion.Turning`, also for the next three.
        aims: Cost to the goal over each edge, shape (robots, edges).
        directions: Direction of each edge, shape (edges,).
        turns: Cost of turning from each heading to each direction, shape (5, 4).
        random: State of the random numbers, shape (1,).

    Returns:
        Number of rows written; -1 if the given nodes allow no step.
    """
    robots = rows.shape[1]
    nodes = len(indptr) - 1
    occupant = np.full(nodes, -1, np.int32)
    taken = np.full(nodes, -1, np.int32)
    after = fixed.copy()
    most = 0
    for node in range(nodes):
        most = max(most, indptr[node + 1] - indptr[node])
    keys = np.zeros(most + 1, np.int64)
    stack = np.zeros((robots + 1, 4), np.int32)
    found = np.zeros((robots + 1, most + 1), np.int32)
    has_fixed = False
    for robot in range(robots):
        if after[robot] != OPEN:
            has_fixed = True
            if taken[after[robot]] >= 0:
                return -1
            taken[after[robot]] = robot
        occupant[rows[0, robot]] = robot
    for step in range(rows.shape[0] - 1):
        now = rows[step]
        for place in range(1, robots):  # the order changes little from step to step
            robot = order[place]
            wanted = urgency[step, robot]
            while place > 0 and urgency[step, order[place - 1]] < wanted:
                order[place] = order[place - 1]
                place -= 1  # noqa: PLW2901  # the loop's own variable is not used after it
            order[place] = robot
        if not _next_nodes(
            indptr, neighbours, table, far, goals, now, after, order, occupant, taken, flags,
            facing[step], turning, aims, directions, turns, random, keys, stack, found,
        ):  # fmt: skip
            return step if step > 0 else -1
        if has_fixed and not _is_valid(now, after, occupant, flags):
            return -1
        has_fixed = False
        for robot in range(robots):
            occupant[now[robot]] = -1
        done = True
        for robot in range(robots):
            node = after[robot]
            rows[step + 1, robot] = node
            facing[step + 1, robot] = facing[step, robot]
            if turning[robot] > 0 and node != now[robot]:
                for edge in range(indptr[now[robot]], indptr[now[robot] + 1]):
                    if neighbours[edge] == node:
                        facing[step + 1, robot] = directions[edge]
            occupant[node] = robot
            taken[node] = -1
            after[robot] = OPEN
            if node == goals[robot]:
                urgency[step + 1, robot] = 0
            else:
                done = False
                urgency[step + 1, robot] = urgency[step, robot] + 1
        if done:
            return step + 1
    return len(rows) - 1


_SIGNATURE = (
    "int64(int32[::1], int32[::1], {table}[:, ::1], int64, int32[::1], int32[::1], int32[:, ::1], "
    "int32[:, ::1], int32[::1], int64, int32[:, ::1], int32[::1], int32[:, ::1], int32[::1], int32[:, ::1], "
    "int64[::1])"
)
roll_out = kernel(_SIGNATURE.format(table="int16"), _SIGNATURE.format(table="int32"), numpy=_roll_out)(
    _roll_out
)
