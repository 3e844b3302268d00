"""What operators and ERP want of the planner, so that one that was restarted can be told again. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class DesiredGoal:
    """A robot is to go to a cell."""

    robot: str
    cell: int


@dataclass(frozen=True, slots=True)
class DesiredCell:
    """A cell is to be blocked, or free."""

    cell: int
    blocked: bool


class Desired:
    """The newest request for each robot and each cell."""

    def __init__(self) -> None:
        self._goals: dict[str, int] = {}
        self._cells: dict[int, bool] = {}

    def set_goal(self, robot: str, cell: int | None) -> None:
        """The planner took a goal for a robot; None: it has none any more."""
        if cell is None:
            self._goals.pop(robot, None)
        else:
            self._goals[robot] = cell

    def set_cell(self, cell: int, *, blocked: bool) -> None:
        """The planner blocked or freed a cell."""
        self._cells[cell] = blocked

    def unmet(self, state: dict[str, Any]) -> list[DesiredCell | DesiredGoal]:
        """What a planner that says ``state`` (a fleet/FleetState in its JSON form) does not know.

        Cells come first, so that no path is planned through them. Robots that it does not know yet are left
        out, and so are those that somebody else sends somewhere.
        """
        shut = {*state["blocked"], *state["pending"]}
        cells = [
            DesiredCell(cell, blocked)
            for cell, blocked in self._cells.items()
            if blocked != (cell in shut) and cell not in state["walls"]
        ]
        goals = [
            DesiredGoal(robot["id"], self._goals[robot["id"]])
            for robot in state["robots"]
            if robot["id"] in self._goals and robot["goal"] < 0
        ]
        return [*cells, *goals]
