"""Chooses cells to block on the robots' paths while they drive, and checks that a robot replans. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import Enum

from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.scenario import midway_cell, solvable
from rce_fleet.station.api import FleetModel

REPLAN_TIMEOUT = 4.0
"""Seconds after which a blocked cell is freed if no robot replanned."""
EFFECT_TIMEOUT = 30.0
"""Seconds for a cell to become blocked; a robot that is in it has to leave it first."""
NEAR_CELLS = 2
"""This many of the cells granted to a robot, from its own on, are never blocked."""


class BlockAction(Enum):
    """What to do with :attr:`CellBlocker.cell`."""

    NOTHING = "nothing"
    BLOCK = "block"
    FREE = "free"


@dataclass(slots=True)
class _Attempt:
    cell: int
    since: float
    replans: dict[str, int]


class CellBlocker:
    """Decides which cells to block, one after another, and when to free one again.

    A cell is blocked only if all robots can still reach their goals around it, at the same time. A cell is
    freed if robots crossed it before the box was there, and the box now cuts them off from their goals.

    Args:
        grid: The map with its walls.
        goals: Goal of each robot.
        count: How many cells to block; fewer are blocked if there are not enough candidates.

    Attributes:
        cell: The cell that the last returned action concerns.
        done: Cells that were blocked with effect: each has a box, and a robot replanned for it.
    """

    def __init__(self, grid: GridMap, goals: Mapping[str, int], count: int = 1) -> None:
        self.cell = -1
        self.done: list[int] = []
        self._count = count
        self._rejected: set[int] = set()
        self._grid = grid
        self._goals = goals
        self._attempt: _Attempt | None = None

    @property
    def in_progress(self) -> bool:
        """Whether a cell was blocked whose effect is not seen yet."""
        return self._attempt is not None

    def update(self, fleet: FleetModel, boxes: Collection[int], now: float) -> BlockAction:
        """Return what to do next, given the state of the fleet.

        Args:
            fleet: The state that the planner reports.
            boxes: Cells that hold a box in the simulated world, whether the planner knows of it or not.
            now: Seconds of a steady clock.
        """
        if self._attempt is None:
            return BlockAction.NOTHING if len(self.done) >= self._count else self._begin(fleet, boxes, now)
        attempt, waited = self._attempt, now - self._attempt.since
        replanned = any(robot.replans > attempt.replans.get(robot.id, 0) for robot in fleet.robots)
        blocked = attempt.cell in fleet.blocked
        if blocked and attempt.cell in boxes and self._cuts_off(fleet, boxes):
            self._attempt = None
            self._rejected.add(attempt.cell)
            return BlockAction.FREE
        if replanned and blocked and attempt.cell in boxes:
            self._attempt = None
            self.done.append(attempt.cell)
        elif waited > EFFECT_TIMEOUT or (waited > REPLAN_TIMEOUT and not replanned):
            self._attempt = None
            return BlockAction.FREE
        return BlockAction.NOTHING

    def on_refused(self) -> None:
        """Forget the current attempt: the planner refused to block the cell."""
        self._attempt = None

    def _begin(self, fleet: FleetModel, boxes: Collection[int], now: float) -> BlockAction:
        cell = self._choose(fleet, boxes)
        if cell is None:
            return BlockAction.NOTHING
        self.cell = cell
        self._attempt = _Attempt(cell, now, {robot.id: robot.replans for robot in fleet.robots})
        return BlockAction.BLOCK

    def _choose(self, fleet: FleetModel, boxes: Collection[int]) -> int | None:
        """Return a cell that is not granted yet; else one that is not directly ahead of a robot."""
        grid = self._with_all_blocked(fleet, boxes)
        plans = {robot.id: robot.plan for robot in fleet.robots if robot.plan}
        if not all(robot in plans for robot in self._goals):
            return None
        for reach in (None, NEAR_CELLS):
            avoid = self._rejected.union(*(robot.granted[:reach] for robot in fleet.robots))
            cell = midway_cell(grid, plans, self._goals, avoid)
            if cell is not None:
                return cell
        return None

    def _with_all_blocked(self, fleet: FleetModel, boxes: Collection[int]) -> GridMap:
        return self._grid.with_blocked({*self._grid.blocked, *fleet.blocked, *fleet.pending, *boxes})

    def _cuts_off(self, fleet: FleetModel, boxes: Collection[int]) -> bool:
        """Return whether some robot cannot reach its goal any more; False while cells are unknown."""
        cells = {robot.id: robot.cell for robot in fleet.robots if robot.id in self._goals}
        starts = [cell for cell in cells.values() if cell is not None]
        if len(set(starts)) < len(self._goals):
            return False
        return not solvable(
            self._with_all_blocked(fleet, boxes), starts, [self._goals[robot] for robot in cells]
        )
