"""One run of a scenario: sends every robot to its goal, blocks cells on the way, waits for the arrivals."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import Any, assert_never

from rce_fleet.demo.blocking import BlockAction, CellBlocker
from rce_fleet.demo.speed import WorldSpeed
from rce_fleet.drivers.report import WorldReport
from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.planning.scenario import Scenario
from rce_fleet.station.api import FleetModel, RobotModel
from rce_fleet.station.client import StationClient

POLL_S = 0.2
"""Seconds between two requests for the fleet's state."""
MIN_DISTANCE = 0.3
"""Cells are blocked once a robot has driven this far in the simulated world, metres."""


class ScenarioRun:
    """Drives a fleet through a scenario, over the station's API.

    Goals and blocked cells that the planner does not report, after a restart for instance, are sent again.

    Args:
        station: The station's API.
        scenario: Robots and their goals.
        truth: Returns the state of the simulated world.
        say: Prints a line for the user.
        blocked_cells: How many cells to block on the way, as long as every goal can be reached.

    Attributes:
        goals: Goal of each robot.
        reached: Robots that stand at their goals, both as reported by the planner and in the world.
        replans: How often each robot got a new path.
        blocker: The cells that are blocked on the way.
        speed: How fast the simulated world runs.
    """

    def __init__(
        self,
        station: StationClient,
        scenario: Scenario,
        truth: Callable[[], WorldReport | None],
        say: Callable[[str], None],
        blocked_cells: int = 1,
    ) -> None:
        self.goals = dict(zip(scenario.robots, scenario.goals, strict=True))
        self.reached: set[str] = set()
        self.replans = dict.fromkeys(scenario.robots, 0)
        self.blocker = CellBlocker(scenario.grid, self.goals, blocked_cells)
        self.speed = WorldSpeed()
        self._station = station
        self._truth = truth
        self._say = say
        self._started: float | None = None
        self._ended: float | None = None
        self._known_replans: dict[str, int] = {}
        self._fleet: FleetModel | None = None
        self._refusal = ""

    @property
    def missing(self) -> list[str]:
        """The robots that are not at their goals: each with what the planner and the world say of it."""
        known = {} if self._fleet is None else {robot.id: robot for robot in self._fleet.robots}
        truth = self._truth()
        cells = {} if truth is None else {robot.id: robot.cell for robot in truth.robots}
        return [
            f"{robot} ({_state_of(known.get(robot), cells.get(robot))})"
            for robot in self.goals
            if robot not in self.reached
        ]

    @property
    def refusal(self) -> str:
        """Why the last request that failed was not carried out; empty if none failed."""
        return self._refusal

    @property
    def duration(self) -> float:
        """Seconds from the goals to the last arrival, or until now."""
        if self._started is None:
            return 0.0
        return (self._ended or time.monotonic()) - self._started

    async def run(self) -> None:
        """Run until every robot stands at its goal."""
        while True:
            if self._all_placed(await self._read_fleet()):
                break
            await asyncio.sleep(POLL_S)
        self._say(f"{len(self.goals)} robots are ready; sending their goals")
        self._started = time.monotonic()
        while True:
            fleet, truth = await self._read_fleet(), self._truth()
            if truth is not None:
                self.speed.look(truth, time.monotonic())
            if fleet is not None and truth is not None:
                self._count_replans(fleet)
                self._update_reached(fleet, truth)
                if len(self.reached) == len(self.goals) and not self.blocker.in_progress:
                    break
                await self._send_missing(fleet)
                await self._update_blocked(fleet, truth)
            await asyncio.sleep(POLL_S)
        self._ended = time.monotonic()

    # State

    async def _read_fleet(self) -> FleetModel | None:
        try:
            self._fleet = await self._station.fleet()
        except StationUnavailableError as error:
            self._refusal = str(error)
            return None
        return self._fleet

    def _all_placed(self, fleet: FleetModel | None) -> bool:
        """Return whether the planner knows the cell of every robot."""
        if fleet is None:
            return False
        placed = {robot.id for robot in fleet.robots if robot.cell is not None and robot.state == "idle"}
        return placed.issuperset(self.goals)

    def _count_replans(self, fleet: FleetModel) -> None:
        for robot in fleet.robots:
            known = self._known_replans.get(robot.id, 0)
            self.replans[robot.id] = self.replans.get(robot.id, 0) + max(robot.replans - known, 0)
            self._known_replans[robot.id] = robot.replans

    def _update_reached(self, fleet: FleetModel, truth: WorldReport) -> None:
        """Set the robots that are at their goals now: a robot may leave its goal to let another one pass."""
        cells = {robot.id: robot.cell for robot in truth.robots}
        there = {
            robot.id
            for robot in fleet.robots
            if robot.state == "arrived" and robot.cell == self.goals.get(robot.id) == cells.get(robot.id)
        }
        for robot in sorted(there - self.reached):
            self._say(f"{robot} is at its goal, cell {self.goals[robot]}")
        self.reached = there

    # Requests

    async def _send_missing(self, fleet: FleetModel) -> None:
        for robot in fleet.robots:
            goal = self.goals.get(robot.id)
            if goal is not None and robot.goal != goal:
                await self._request(self._station.set_goal(robot.id, goal))
        for cell in self.blocker.done:
            if cell not in {*fleet.blocked, *fleet.pending}:
                await self._request(self._station.set_blocked(cell, blocked=True))

    async def _update_blocked(self, fleet: FleetModel, truth: WorldReport) -> None:
        if not any(robot.distance_m > MIN_DISTANCE for robot in truth.robots):
            return
        blocker, done = self.blocker, len(self.blocker.done)
        action = blocker.update(fleet, truth.boxes, time.monotonic())
        match action:
            case BlockAction.BLOCK:
                on_path = [robot.id for robot in fleet.robots if blocker.cell in robot.plan]
                self._say(f"blocking cell {blocker.cell} on the path of {', '.join(on_path)}")
                if not await self._request(self._station.set_blocked(blocker.cell, blocked=True)):
                    blocker.on_refused()
            case BlockAction.FREE:
                self._say(f"freeing cell {blocker.cell}: no robot replanned, or a goal was cut off")
                await self._request(self._station.set_blocked(blocker.cell, blocked=False))
            case BlockAction.NOTHING:
                if len(blocker.done) > done:
                    self._say(f"cell {blocker.done[-1]} is blocked and holds a box")
            case _:
                assert_never(action)

    async def _request(self, request: Coroutine[Any, Any, None]) -> bool:
        """Send a request; return whether it was carried out."""
        try:
            await request
        except StationUnavailableError as error:
            self._refusal = str(error)
            return False
        except RequestRefusedError as error:
            self._refusal = str(error)
            self._say(f"refused: {error}")
            return False
        return True


def _state_of(robot: RobotModel | None, cell: int | None) -> str:
    """Describe where a robot is, and what it waits for.

    Args:
        robot: What the planner knows of it; None if it was never read.
        cell: The cell that it is in in the simulated world; None if that is not known.
    """
    if robot is None:
        return "the planner does not know it"
    reason = f", {robot.reason}" if robot.reason else ""
    goal = f"goal {'none' if robot.goal is None else robot.goal}"
    where = f"cell {robot.cell}" if robot.cell == cell else f"cell {robot.cell}, in the world cell {cell}"
    return f"{robot.state}{reason}; {where}; {goal}; plan {robot.plan}, granted {robot.granted}"
