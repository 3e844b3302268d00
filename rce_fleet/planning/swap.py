"""Finds robots that have to change places, which PIBT alone cannot do in narrow passages.

After Okumura, "Improving LaCAM for Scalable Eventually Optimal Multi-Agent Pathfinding" (2023, section 4):
two robots that face each other in a passage both move in the direction of one of them, until the passage has
a side arm. Whether they must, and whether there is one, is found by following the passage node by node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.compiled import helper

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Table = NDArray[np.int16] | NDArray[np.int32]

OPEN = -1
"""In a row of next nodes: not chosen yet."""


@helper
def draw(random: NDArray[np.int64]) -> int:
    """Return 23 random bits; ``random`` holds the state of the generator, 31 bits."""
    random[0] = (random[0] * 1103515245 + 12345) & 0x7FFFFFFF
    return int(random[0] >> 8)


@helper
def _exits(
    indptr: Ints, neighbours: Ints, goals: Ints, occupant: Ints, node: int, back: int
) -> tuple[int, int]:
    """Count the ways out of a passage's node, without the way back and dead ends whose robot is at its goal.

    Returns:
        Number of exits, and the last of them.
    """
    count, ahead = 0, -1
    for edge in range(indptr[node], indptr[node + 1]):
        other = neighbours[edge]
        if other == back:
            continue
        if indptr[other + 1] - indptr[other] == 1:
            robot = occupant[other]
            if robot >= 0 and goals[robot] == other:
                continue
        count += 1
        ahead = other
    return count, ahead


@helper
def _is_swap_required(
    indptr: Ints,
    neighbours: Ints,
    table: Table,
    goals: Ints,
    occupant: Ints,
    pusher: int,
    pulled: int,
    back: int,
    front: int,
) -> bool:
    """Return whether ``pusher`` moves to where ``pulled`` is, and ``pulled`` towards it, in a passage."""
    while table[pusher, front] < table[pusher, back]:
        count, ahead = _exits(indptr, neighbours, goals, occupant, front, back)
        if count > 1:
            return False
        if count < 1:
            break
        back, front = front, ahead
    return bool(
        table[pulled, back] < table[pulled, front]
        and (table[pusher, back] == 0 or table[pusher, front] < table[pusher, back])
    )


@helper
def _is_swap_possible(
    indptr: Ints, neighbours: Ints, goals: Ints, occupant: Ints, back: int, front: int
) -> bool:
    """Return whether the passage from ``back`` over ``front`` leads to a node with two exits."""
    begin, passed = back, 0
    while front != begin and passed < len(indptr):  # one-way passages may end in a ring of such
        count, ahead = _exits(indptr, neighbours, goals, occupant, front, back)
        if count != 1:
            return bool(count > 1)
        back, front = front, ahead
        passed += 1
    return False


@helper
def swap_partner(
    indptr: Ints,
    neighbours: Ints,
    table: Table,
    goals: Ints,
    now: Ints,
    after: Ints,
    occupant: Ints,
    robot: int,
    best: int,
) -> int:
    """Return the robot that ``robot`` has to change places with; -1 if there is none."""
    here = now[robot]
    if best == here:
        return -1
    ahead = occupant[best]
    if (
        ahead >= 0
        and after[ahead] == OPEN
        and _is_swap_required(indptr, neighbours, table, goals, occupant, robot, ahead, here, best)
        and _is_swap_possible(indptr, neighbours, goals, occupant, best, here)
    ):
        return int(ahead)
    for edge in range(indptr[here], indptr[here + 1]):
        behind = occupant[neighbours[edge]]
        if behind < 0 or neighbours[edge] == best:
            continue
        # A robot behind has to get past; this robot clears the way by moving on ahead of it.
        if _is_swap_required(
            indptr, neighbours, table, goals, occupant, behind, robot, here, best
        ) and _is_swap_possible(indptr, neighbours, goals, occupant, best, here):
            return int(behind)
    return -1
