"""The headless run: every robot gets a goal, cells are blocked under way, and all have to arrive."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import Any

from rce_fleet.demo.blocking import MidwayBlock, Step
from rce_fleet.demo.exceptions import StationAwayError, WishRefusedError
from rce_fleet.demo.station import StationApi
from rce_fleet.drivers.report import WorldReport
from rce_fleet.planning.scenario import Scenario
from rce_fleet.station.api import FleetModel

LOOK_EVERY = 0.2
"""Seconds between two looks at the fleet."""
UNDER_WAY = 0.3
"""Robots are under way once one of them truly drove so far, metres."""


class Mission:
    """One headless run.

    What the planner does not know, or no longer after a restart, is said again until it does.

    Args:
        station: Carries the requests.
        scenario: Robots and their goals.
        truth: Says what truly happens in the world.
        say: Gets lines for people.
        blocked_cells: How many cells are blocked under way, where that leaves every goal in reach.

    Attributes:
        goals: Goal of each robot.
        reached: Robots that stand at their goals, by the planner's word and in truth.
        replans: How often each robot got a new path.
        block: The cells that are blocked under way.
    """

    def __init__(
        self,
        station: StationApi,
        scenario: Scenario,
        truth: Callable[[], WorldReport | None],
        say: Callable[[str], None],
        blocked_cells: int = 1,
    ) -> None:
        self.goals = dict(zip(scenario.robots, scenario.goals, strict=True))
        self.reached: set[str] = set()
        self.replans = dict.fromkeys(scenario.robots, 0)
        self.block = MidwayBlock(scenario.grid, self.goals, blocked_cells)
        self._station = station
        self._truth = truth
        self._say = say
        self._started: float | None = None
        self._ended: float | None = None
        self._known_replans: dict[str, int] = {}

    @property
    def duration(self) -> float:
        """Seconds from the goals to the last arrival, or until now."""
        if self._started is None:
            return 0.0
        return (self._ended or time.monotonic()) - self._started

    async def run(self) -> None:
        """Run until every robot stands at its goal."""
        while True:
            if self._assembled(await self._look()):
                break
            await asyncio.sleep(LOOK_EVERY)
        self._say(f"{len(self.goals)} robots are in their places and get their goals")
        self._started = time.monotonic()
        while True:
            fleet, truth = await self._look(), self._truth()
            if fleet is not None and truth is not None:
                self._count(fleet)
                self._see_arrivals(fleet, truth)
                if len(self.reached) == len(self.goals) and not self.block.under_way:
                    break
                await self._insist(fleet)
                await self._block(fleet, truth)
            await asyncio.sleep(LOOK_EVERY)
        self._ended = time.monotonic()

    # -- seeing ---------------------------------------------------------------------------------------

    async def _look(self) -> FleetModel | None:
        try:
            return await self._station.fleet()
        except StationAwayError:
            return None

    def _assembled(self, fleet: FleetModel | None) -> bool:
        """Whether the planner has given every robot its place."""
        if fleet is None:
            return False
        placed = {robot.id for robot in fleet.robots if robot.cell is not None and robot.state == "idle"}
        return placed.issuperset(self.goals)

    def _count(self, fleet: FleetModel) -> None:
        for robot in fleet.robots:
            known = self._known_replans.get(robot.id, 0)
            self.replans[robot.id] = self.replans.get(robot.id, 0) + max(robot.replans - known, 0)
            self._known_replans[robot.id] = robot.replans

    def _see_arrivals(self, fleet: FleetModel, truth: WorldReport) -> None:
        """Arrived is who stands there now: a robot may have to make way for another one."""
        cells = {robot.id: robot.cell for robot in truth.robots}
        there = {
            robot.id
            for robot in fleet.robots
            if robot.state == "arrived" and robot.cell == self.goals.get(robot.id) == cells.get(robot.id)
        }
        for robot in sorted(there - self.reached):
            self._say(f"{robot} is at its goal, cell {self.goals[robot]}")
        self.reached = there

    # -- wishing --------------------------------------------------------------------------------------

    async def _insist(self, fleet: FleetModel) -> None:
        for robot in fleet.robots:
            goal = self.goals.get(robot.id)
            if goal is not None and robot.goal != goal:
                await self._send(self._station.set_goal(robot.id, goal))
        for cell in self.block.done:
            if cell not in {*fleet.blocked, *fleet.pending}:
                await self._send(self._station.block(cell, blocked=True))

    async def _block(self, fleet: FleetModel, truth: WorldReport) -> None:
        if not any(robot.distance_m > UNDER_WAY for robot in truth.robots):
            return
        block, done = self.block, len(self.block.done)
        match block.look(fleet, truth.boxes, time.monotonic()):
            case Step.BLOCK:
                on_path = [robot.id for robot in fleet.robots if block.cell in robot.plan]
                self._say(f"blocking cell {block.cell} on the path of {', '.join(on_path)}")
                if not await self._send(self._station.block(block.cell, blocked=True)):
                    block.refused()
            case Step.FREE:
                self._say(f"freeing cell {block.cell}: no robot had to replan, or goals could not be reached")
                await self._send(self._station.block(block.cell, blocked=False))
            case Step.NOTHING if len(block.done) > done:
                self._say(f"cell {block.cell} is blocked, and holds a box")

    async def _send(self, request: Coroutine[Any, Any, None]) -> bool:
        """Send a request; tell whether it was granted."""
        try:
            await request
        except StationAwayError:
            return False
        except WishRefusedError as error:
            self._say(f"refused: {error}")
            return False
        return True
