"""Goals and blocked cells that were requested, to send them again to a restarted planner. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class DesiredGoal:
    """A robot shall drive to a cell."""

    robot: str
    cell: int


@dataclass(frozen=True, slots=True)
class DesiredCell:
    """A cell shall be blocked, or free."""

    cell: int
    blocked: bool


class Desired:
    """The newest request for each robot and each cell."""

    def __init__(self) -> None:
        self._goals: dict[str, int] = {}
        self._cells: dict[int, bool] = {}

    def set_goal(self, robot: str, cell: int | None) -> None:
        """Store a goal that the planner accepted; None removes it."""
        if cell is None:
            self._goals.pop(robot, None)
        else:
            self._goals[robot] = cell

    def set_cell(self, cell: int, *, blocked: bool) -> None:
        """Store whether the planner blocked or freed a cell."""
        self._cells[cell] = blocked

    def unmet(self, state: dict[str, Any]) -> list[DesiredCell | DesiredGoal]:
        """Return what is missing in a planner's ``state`` (a fleet/FleetState in its JSON form).

        Cells come first, so that no path is planned through them. Robots that the planner does not know yet,
        or that have another goal, are left out.
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
