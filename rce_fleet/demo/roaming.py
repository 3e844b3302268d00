"""Keeps the demo's robots busy until the operator takes them over."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from random import Random

from rce_fleet.demo.exceptions import StationAwayError, WishRefusedError
from rce_fleet.demo.station import StationApi
from rce_fleet.station.api import FleetModel

LOOK_EVERY = 1.0
"""Seconds between two looks at the fleet."""
REST = 3.0
"""Seconds that a robot stands at its goal before it gets the next one."""
STANDING = ("idle", "arrived")


class Roamer:
    """Chooses goals. Pure: looks at states, says who is to go where.

    A robot whose goal somebody else set is left to that somebody for good.

    Args:
        rng: Source of the goals.
    """

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._given: dict[str, int] = {}
        self._tried: dict[str, int] = {}
        self._free_since: dict[str, float] = {}
        self._taken_over: set[str] = set()

    @property
    def taken_over(self) -> frozenset[str]:
        """Robots that the operator sends."""
        return frozenset(self._taken_over)

    def look(self, fleet: FleetModel, now: float) -> dict[str, int]:
        """Look at the fleet at ``now`` (seconds); returns the robots that shall get new goals."""
        goals: dict[str, int] = {}
        for robot in fleet.robots:
            if robot.goal is not None and robot.goal == self._tried.get(robot.id):
                self._given[robot.id] = self._tried.pop(robot.id)
                self._free_since.pop(robot.id, None)
            if robot.goal not in (None, self._given.get(robot.id)):
                self._taken_over.add(robot.id)
            if robot.id in self._taken_over or robot.state not in STANDING:
                self._free_since.pop(robot.id, None)
                continue
            since = self._free_since.setdefault(robot.id, now)
            if now - since >= REST or robot.goal is None:
                # What was tried before may have been heard: it is said again, not replaced.
                cell = self._tried.get(robot.id, self._choose(fleet, goals))
                if cell is not None:
                    goals[robot.id] = self._tried[robot.id] = cell
        return goals

    def refused(self, robot: str) -> None:
        """A goal was not taken, and is not to be tried again."""
        self._tried.pop(robot, None)

    def _choose(self, fleet: FleetModel, goals: dict[str, int]) -> int | None:
        if fleet.map is None:
            return None
        taken = {*fleet.blocked, *fleet.pending, *goals.values()}
        for robot in fleet.robots:
            taken.update(cell for cell in (robot.goal, robot.cell) if cell is not None)
        free = [cell for cell in range(fleet.map.rows * fleet.map.columns) if cell not in taken]
        return self._rng.choice(free) if free else None


async def roam(station: StationApi, rng: Random, say: Callable[[str], None]) -> None:
    """Give robots goals until cancelled."""
    roamer, told = Roamer(rng), frozenset[str]()
    while True:
        with contextlib.suppress(StationAwayError):
            for robot, cell in roamer.look(await station.fleet(), time.monotonic()).items():
                try:
                    await station.set_goal(robot, cell)
                except WishRefusedError:
                    roamer.refused(robot)
        for robot in sorted(roamer.taken_over - told):
            say(f"{robot} is yours now: it waits for your goals")
        told = roamer.taken_over
        await asyncio.sleep(LOOK_EVERY)
