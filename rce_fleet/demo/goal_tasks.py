"""A stream of tasks without the fleet manager: each task is a goal of one robot."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Self

from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from random import Random
    from types import TracebackType

    from rce_fleet.station.api import FleetModel, RobotModel
    from rce_fleet.station.client import StationClient

LOST_AFTER = 60.0
"""Seconds after which a task that the fleet does not show is lost."""


class GoalTasks:
    """Sends each robot that has done its task to another cell.

    The station keeps the goals and sends them again to a planner that was restarted; nothing is sent twice
    from here.

    Args:
        station: The station's API.
        cells: Where tasks may lead.
        rng: Draws the cells.

    Attributes:
        accepted: Number of tasks that the fleet accepted.
        done: Number of those that it has done.
        lost: Those that it forgot, in words.
        failed: None.
        done_by: Number of done tasks by robot.
    """

    def __init__(self, station: StationClient, cells: Sequence[int], rng: Random) -> None:
        self.accepted = self.done = 0
        self.lost: list[str] = []
        self.failed: list[str] = []
        self.done_by: dict[str, int] = {}
        self._station = station
        self._cells = cells
        self._rng = rng
        self._goals: dict[str, int] = {}
        self._seen_at: dict[str, float] = {}

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    @property
    def busy(self) -> Collection[str]:
        """Robots that drive to a goal."""
        return self._goals.keys()

    @property
    def open(self) -> int:
        """Number of goals that are not reached yet."""
        return len(self._goals)

    async def update(self, fleet: FleetModel, *, more: bool) -> None:
        """See which robots arrived, and send them on."""
        now = time.monotonic()
        for robot in fleet.robots:
            self._look_at(robot, now)
        if not more:
            return
        taken = {*fleet.blocked, *fleet.pending}
        for robot in fleet.robots:
            taken.update(cell for cell in (robot.goal, robot.cell) if cell is not None)
        for robot in fleet.robots:
            if robot.id not in self._goals and robot.cell is not None:
                await self._send(robot.id, taken)

    async def settle(self) -> None:
        """Do nothing: what became of goals is in the state of the fleet."""

    def _look_at(self, robot: RobotModel, now: float) -> None:
        goal = self._goals.get(robot.id)
        if goal is None:
            return
        if robot.goal == goal:
            self._seen_at[robot.id] = now
            if robot.state == "arrived" and robot.cell == goal:
                del self._goals[robot.id]
                self.done += 1
                self.done_by[robot.id] = self.done_by.get(robot.id, 0) + 1
        elif now - self._seen_at[robot.id] > LOST_AFTER:
            del self._goals[robot.id]
            self.lost.append(f"{robot.id} to cell {goal}")

    async def _send(self, robot: str, taken: set[int]) -> None:
        free = [cell for cell in self._cells if cell not in taken]
        if not free:
            return
        cell = self._rng.choice(free)
        try:
            await self._station.set_goal(robot, cell)
        except (RequestRefusedError, StationUnavailableError):
            return  # not accepted: another one is drawn at the next update
        taken.add(cell)
        self.accepted += 1
        self._goals[robot] = cell
        self._seen_at[robot] = time.monotonic()
