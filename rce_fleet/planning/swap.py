"""Finds robots that have to change places, which PIBT alone cannot do in narrow passages.

After Okumura, "Improving LaCAM for Scalable Eventually Optimal Multi-Agent Pathfinding" (2023): two robots
that face each other in a passage both move in the direction of one of them, until the passage has a side arm.
Whether they must, and whether there is one, is found by simulating their moves cell by cell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence


class SwapFinder:
    """Finds the robot that another one has to change places with.

    Args:
        neighbours: For every cell the cells that can be entered from it.
        fields: For every robot the distance to its goal from every cell.
    """

    def __init__(self, neighbours: Sequence[Sequence[int]], fields: Sequence[Sequence[float]]) -> None:
        self._neighbours = neighbours
        self._fields = fields

    def partner(
        self,
        robot: int,
        best: int,
        now: Sequence[int],
        occupant: Mapping[int, int],
        undecided: Callable[[int], bool],
    ) -> int | None:
        """Return the robot to change places with; ``None`` if that is not needed, or not possible.

        Args:
            robot: The robot that moves.
            best: Its best next cell.
            now: Cells of all robots.
            occupant: The robot in each cell.
            undecided: Returns whether a robot's next cell is not chosen yet.
        """
        here = now[robot]
        if best == here:
            return None
        ahead = occupant.get(best)
        if (
            ahead is not None
            and undecided(ahead)
            and self._required(robot, ahead, here, best, occupant)
            and self._possible(best, here, occupant)
        ):
            return ahead
        for cell in self._neighbours[here]:
            behind = occupant.get(cell)
            if behind is None or cell == best:
                continue
            # A robot behind has to get past; this robot clears the way by moving on ahead of it.
            if self._required(behind, robot, here, best, occupant) and self._possible(best, here, occupant):
                return behind
        return None

    def _required(self, pusher: int, pulled: int, back: int, front: int, occupant: Mapping[int, int]) -> bool:
        """Return whether ``pusher`` moves to where ``pulled`` is, and ``pulled`` moves towards it."""
        push, pull = self._fields[pusher], self._fields[pulled]
        for before, cell, exits in self._passage(back, front, occupant):
            back, front = before, cell
            if push[front] >= push[back] or exits == 0:
                break
            if exits > 1:
                return False
        return pull[back] < pull[front] and (push[back] == 0 or push[front] < push[back])

    def _possible(self, back: int, front: int, occupant: Mapping[int, int]) -> bool:
        """Return whether a passage from ``back`` over ``front`` leads to a cell with two exits."""
        for _, cell, exits in self._passage(back, front, occupant):
            if cell == back:
                return False
            if exits != 1:
                return exits > 1
        return False

    def _passage(self, back: int, front: int, occupant: Mapping[int, int]) -> Iterator[tuple[int, int, int]]:
        """Follow a passage; yield the previous cell, the cell, and the number of its exits."""
        for _ in range(len(self._neighbours)):
            ways = [
                cell for cell in self._neighbours[front] if cell != back and not self._filled(cell, occupant)
            ]
            yield back, front, len(ways)
            if len(ways) != 1:
                return
            back, front = front, ways[0]

    def _filled(self, cell: int, occupant: Mapping[int, int]) -> bool:
        """Return whether a cell is a dead end with a robot in it whose goal it is."""
        robot = occupant.get(cell)
        return robot is not None and len(self._neighbours[cell]) == 1 and self._fields[robot][cell] == 0
