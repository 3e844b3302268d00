"""Blocks cells on the robots' paths while they drive, and sees that it takes effect."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import Enum

from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.scenario import midway_cell, solvable
from rce_fleet.station.api import FleetModel

REPLAN_TIMEOUT = 4.0
"""Seconds after which a cell that made nobody replan is given back."""
EFFECT_TIMEOUT = 30.0
"""Seconds for a cell to become blocked; a robot that is in it has to leave it first."""
NEAR = 2
"""So many of the cells that a robot was granted, from its own on, are not put under its wheels."""


class Step(Enum):
    """What is to be done now."""

    NOTHING = "nothing"
    BLOCK = "block"
    FREE = "free"


@dataclass(slots=True)
class _Try:
    cell: int
    since: float
    replans: dict[str, int]


class MidwayBlock:
    """Decides which cells to block one after another, and when. Pure: looks at states, says what to do.

    A cell is blocked only while all robots can still get to their goals around it, at the same time. Where
    robots crossed it before the box was there and it parts them from their goals now, it is freed again.

    Args:
        grid: The map with its walls.
        goals: Goal of each robot.
        count: How many cells are to be blocked; fewer are where there are not so many.

    Attributes:
        cell: The cell to be blocked or freed by the step that was returned last.
        done: Cells that were blocked with effect: they have a box, and a robot got a new path for each.
    """

    def __init__(self, grid: GridMap, goals: Mapping[str, int], count: int = 1) -> None:
        self.cell = -1
        self.done: list[int] = []
        self._count = count
        self._harmful: set[int] = set()
        self._grid = grid
        self._goals = goals
        self._try: _Try | None = None

    @property
    def under_way(self) -> bool:
        """Whether a cell was blocked that has not shown its effect yet."""
        return self._try is not None

    def look(self, fleet: FleetModel, boxes: Collection[int], now: float) -> Step:
        """Look at the fleet while it drives.

        Args:
            fleet: What the planner says.
            boxes: Cells that truly hold a box, whether the planner knows of it or not.
            now: Seconds.
        """
        if self._try is None:
            return Step.NOTHING if len(self.done) >= self._count else self._begin(fleet, boxes, now)
        tried, waited = self._try, now - self._try.since
        replanned = any(robot.replans > tried.replans.get(robot.id, 0) for robot in fleet.robots)
        blocked = tried.cell in fleet.blocked
        if blocked and tried.cell in boxes and self._cuts_off(fleet, boxes):
            self._try = None
            self._harmful.add(tried.cell)
            return Step.FREE
        if replanned and blocked and tried.cell in boxes:
            self._try = None
            self.done.append(tried.cell)
        elif waited > EFFECT_TIMEOUT or (waited > REPLAN_TIMEOUT and not replanned):
            self._try = None
            return Step.FREE
        return Step.NOTHING

    def refused(self) -> None:
        """The planner did not block the cell."""
        self._try = None

    def _begin(self, fleet: FleetModel, boxes: Collection[int], now: float) -> Step:
        cell = self._choose(fleet, boxes)
        if cell is None:
            return Step.NOTHING
        self.cell = cell
        self._try = _Try(cell, now, {robot.id: robot.replans for robot in fleet.robots})
        return Step.BLOCK

    def _choose(self, fleet: FleetModel, boxes: Collection[int]) -> int | None:
        """Rather a cell that nobody was granted yet; else one that is not just before a robot."""
        grid = self._shut(fleet, boxes)
        plans = {robot.id: robot.plan for robot in fleet.robots if robot.plan}
        if not all(robot in plans for robot in self._goals):
            return None
        for reach in (None, NEAR):
            avoid = self._harmful.union(*(robot.granted[:reach] for robot in fleet.robots))
            cell = midway_cell(grid, plans, self._goals, avoid)
            if cell is not None:
                return cell
        return None

    def _shut(self, fleet: FleetModel, boxes: Collection[int]) -> GridMap:
        return self._grid.with_blocked({*self._grid.blocked, *fleet.blocked, *fleet.pending, *boxes})

    def _cuts_off(self, fleet: FleetModel, boxes: Collection[int]) -> bool:
        """Whether robots cannot all get to their goals any more; False while their cells are not known."""
        cells = {robot.id: robot.cell for robot in fleet.robots if robot.id in self._goals}
        starts = [cell for cell in cells.values() if cell is not None]
        if len(set(starts)) < len(self._goals):
            return False
        return not solvable(self._shut(fleet, boxes), starts, [self._goals[robot] for robot in cells])
