"""PIBT: the next cell of every robot, by priority inheritance with backtracking.

After Okumura et al., "Priority Inheritance with Backtracking for Iterative Multi-agent Path Finding"
(2022), with one rule more: robots may follow one another, but never around in a circle. Execution is
asynchronous: a robot enters a cell only once its predecessor has left it, and in a circle all robots
would wait for each other. An exchange of two robots is the smallest circle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from random import Random

from rce_fleet.planning.swap import SwapFinder

Configuration = tuple[int, ...]
"""The cell of every robot."""

_OPEN = -1


class ConfigurationGenerator:
    """Makes each configuration from the previous one.

    Args:
        neighbours: For every cell the cells that can be entered from it.
        fields: For every robot the distance to its goal from every cell.
        rng: Breaks ties.
    """

    def __init__(
        self, neighbours: Sequence[Sequence[int]], fields: Sequence[Sequence[float]], rng: Random
    ) -> None:
        self._neighbours = neighbours
        self._fields = fields
        self._rng = rng
        self._swaps = SwapFinder(neighbours, fields)
        self._now: Configuration = ()
        self._before: Configuration = ()
        self._next: list[int] = []
        self._occupant: dict[int, int] = {}
        self._taken: dict[int, int] = {}
        self._chain: set[int] = set()

    def generate(
        self, now: Configuration, before: Configuration, order: Sequence[int], fixed: Mapping[int, int]
    ) -> Configuration | None:
        """Return the next configuration: each robot moves to a neighbouring cell or waits.

        Args:
            now: Cells of the robots.
            before: Their cells a step before; among equal choices a robot keeps its direction.
            order: Robots, the most urgent first.
            fixed: Robots whose next cell is given.

        Returns:
            The next configuration; ``None`` if the fixed moves allow none, or this greedy search finds none.
        """
        self._now, self._before = now, before
        self._next = [_OPEN] * len(now)
        self._occupant = {cell: robot for robot, cell in enumerate(now)}
        self._taken = {}
        for robot, cell in fixed.items():
            if cell in self._taken:
                return None
            self._next[robot] = cell
            self._taken[cell] = robot
        for robot in order:
            if self._next[robot] == _OPEN and not self._move(robot):
                return None
        if self._follows_in_a_circle():
            return None
        return tuple(self._next)

    def _move(self, robot: int) -> bool:
        """Find a cell for ``robot``, pushing others on; if there is none, it stays and False is returned."""
        self._chain.add(robot)
        try:
            choices = self._choices(robot)
            partner = self._swaps.partner(robot, choices[0], self._now, self._occupant, self._undecided)
            if partner is not None:
                choices.reverse()
            for index, cell in enumerate(choices):
                if cell in self._taken:
                    continue
                other = self._occupant.get(cell, robot)
                if other != robot and (other in self._chain or self._next[other] == self._now[robot]):
                    continue
                self._next[robot] = cell
                self._taken[cell] = robot
                if other != robot and self._next[other] == _OPEN and not self._move(other):
                    continue
                if index == 0 and partner is not None:
                    self._pull(partner, robot)
                return True
            self._next[robot] = self._now[robot]
            self._taken[self._now[robot]] = robot
            return False
        finally:
            self._chain.discard(robot)

    def _undecided(self, robot: int) -> bool:
        return self._next[robot] == _OPEN

    def _pull(self, partner: int, robot: int) -> None:
        """Let ``partner`` follow ``robot`` into the cell that it leaves."""
        cell = self._now[robot]
        if self._next[partner] == _OPEN and cell not in self._taken:
            self._next[partner] = cell
            self._taken[cell] = partner

    def _choices(self, robot: int) -> list[int]:
        """Return the cells that ``robot`` can be in next, the best first."""
        here = self._now[robot]
        step = here - self._before[robot]
        field = self._fields[robot]
        choices = [*self._neighbours[here], here]
        self._rng.shuffle(choices)
        choices.sort(
            key=lambda cell: (field[cell], cell != here and cell in self._occupant, cell - here != step)
        )
        return choices

    def _follows_in_a_circle(self) -> bool:
        """Return whether some robots all wait for each other to leave; fixed moves can cause that."""
        cleared: set[int] = set()
        for first in range(len(self._now)):
            trail: set[int] = set()
            robot: int | None = first
            while robot is not None and robot not in cleared:
                if robot in trail:
                    return True
                trail.add(robot)
                cell = self._next[robot]
                robot = None if cell == self._now[robot] else self._occupant.get(cell)
            cleared |= trail
        return False
