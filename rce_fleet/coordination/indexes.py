"""Indexes of the robots, so that an event handles only the records that it concerns.

Each index can be rebuilt from the records and the ledger; :meth:`FleetIndex.validate` compares. A robot is
entered again whenever its record or its part of the ledger changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.robot import Phase, RobotRecord
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.coordination.ledger import CellLedger


class RobotsByCell:
    """Cells of some robots, and the robots of a cell."""

    def __init__(self) -> None:
        self.cells: dict[str, frozenset[int]] = {}
        self._robots: dict[int, set[str]] = {}

    def put(self, robot: str, cells: Iterable[int]) -> None:
        """Store the cells of a robot; none removes it."""
        wanted = frozenset(cells)
        before = self.cells.pop(robot, frozenset())
        for cell in before - wanted:
            robots = self._robots[cell]
            robots.discard(robot)
            if not robots:
                del self._robots[cell]
        for cell in wanted - before:
            self._robots.setdefault(cell, set()).add(robot)
        if wanted:
            self.cells[robot] = wanted

    def at(self, cells: Iterable[int]) -> set[str]:
        """Return the robots that have one of these cells."""
        return {robot for cell in cells for robot in self._robots.get(cell, ())}

    def validate(self) -> None:
        """Compare both directions.

        Raises:
            InvariantError: They differ.
        """
        by_robot = {(cell, robot) for robot, cells in self.cells.items() for cell in cells}
        by_cell = {(cell, robot) for cell, robots in self._robots.items() for robot in robots}
        if by_robot != by_cell:
            raise InvariantError(f"cells by robot are {self.cells}, robots by cell {self._robots}")


class FleetIndex:
    """Indexes of robots for the planner's queries.

    Attributes:
        goals: The robot that was sent to a cell, by that cell.
        stopping: Robots with a cell that were told to stand still, and when; the newest last.
        under_way: Active robots that are not at rest in the last cell of their route.
        hindered: Robots that stand still and cannot be placed, and the cells that they overlap.
        displaced: Robots that overlap cells of other robots, or may be in them since before a restart, and
            the cells.
    """

    def __init__(self) -> None:
        self.goals: dict[int, str] = {}
        self.stopping: dict[str, float] = {}
        self.under_way: set[str] = set()
        self.hindered = RobotsByCell()
        self.displaced = RobotsByCell()
        self._goal_of: dict[str, int] = {}

    def enter(self, record: RobotRecord, ledger: CellLedger) -> None:
        """Enter a robot with its current state."""
        robot = record.id
        if self._goal_of.get(robot) != record.goal:
            self._drop_goal(robot)
            if record.goal is not None:
                self._goal_of[robot] = record.goal
                self.goals[record.goal] = robot
        if not is_stopping(record, ledger):
            self.stopping.pop(robot, None)
        elif self.stopping.get(robot) != record.held_at:
            self.stopping.pop(robot, None)
            self.stopping[robot] = record.held_at
        if is_under_way(record, ledger):
            self.under_way.add(robot)
        else:
            self.under_way.discard(robot)
        if record.phase is not Phase.HOLDING:
            self.hindered.put(robot, ())

    def leave(self, robot: str) -> None:
        """Remove a robot."""
        self._drop_goal(robot)
        self.stopping.pop(robot, None)
        self.under_way.discard(robot)
        self.hindered.put(robot, ())
        self.displaced.put(robot, ())

    def last_stop(self) -> float | None:
        """Return when the last robot that is still stopping was told to; None without one."""
        return next(reversed(self.stopping.values()), None)

    def validate(self, records: Iterable[RobotRecord], ledger: CellLedger) -> None:
        """Compare with rebuilt indexes.

        Raises:
            InvariantError: They differ.
        """
        records = list(records)
        wanted = {
            "goals": {record.goal: record.id for record in records if record.goal is not None},
            "stopping": {record.id: record.held_at for record in records if is_stopping(record, ledger)},
            "under_way": {record.id for record in records if is_under_way(record, ledger)},
        }
        for name, value in wanted.items():
            if getattr(self, name) != value:
                raise InvariantError(f"the index {name} is {getattr(self, name)}, but should be {value}")
        if list(self.stopping.values()) != sorted(self.stopping.values()):
            raise InvariantError(f"the index of stopping robots is out of order: {self.stopping}")
        holding = {record.id for record in records if record.phase is Phase.HOLDING}
        if not holding.issuperset(self.hindered.cells):
            raise InvariantError(f"hindered robots are {self.hindered.cells}, but {holding} are holding")
        self.hindered.validate()
        self.displaced.validate()

    def _drop_goal(self, robot: str) -> None:
        goal = self._goal_of.pop(robot, None)
        if goal is not None and self.goals.get(goal) == robot:
            del self.goals[goal]


def is_stopping(record: RobotRecord, ledger: CellLedger) -> bool:
    """Return whether a robot with a cell was told to stand still and is not placed again yet."""
    return record.phase is Phase.HOLDING and ledger.length(record.id) > 0


def is_under_way(record: RobotRecord, ledger: CellLedger) -> bool:
    """Return whether a robot takes part in plans and is not at rest in the last cell of its route."""
    return record.phase is Phase.ACTIVE and not (record.centred and ledger.length(record.id) == 1)
