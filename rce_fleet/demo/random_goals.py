"""Sends robots to random goals until the operator sets a goal for them, and never beside open tasks."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Collection
from random import Random

from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.station.api import FleetModel
from rce_fleet.station.client import StationClient

POLL_S = 1.0
"""Seconds between two requests for the fleet's state."""
PAUSE_AT_GOAL = 3.0
"""Seconds that a robot stands at its goal before it gets the next one."""
STANDING = ("idle", "arrived")


class RandomGoals:
    """Chooses random goals for robots that stand. Pure.

    A robot whose goal was set by the operator gets no further random goals.

    Args:
        rng: Source of the goals.
        among: The cells that are goals; None: all.
    """

    def __init__(self, rng: Random, among: Collection[int] | None = None) -> None:
        self._rng = rng
        self._among = among
        self._given: dict[str, int] = {}
        self._sent: dict[str, int] = {}
        self._idle_since: dict[str, float] = {}
        self._taken_over: set[str] = set()

    @property
    def taken_over(self) -> frozenset[str]:
        """Robots whose goals the operator sets."""
        return frozenset(self._taken_over)

    def update(self, fleet: FleetModel, now: float) -> dict[str, int]:
        """Return the new goals to send, by robot.

        Args:
            fleet: The state that the planner reports.
            now: Seconds of a steady clock.
        """
        goals: dict[str, int] = {}
        for robot in fleet.robots:
            if robot.goal is not None and robot.goal == self._sent.get(robot.id):
                self._given[robot.id] = self._sent.pop(robot.id)
                self._idle_since.pop(robot.id, None)
            if robot.goal not in (None, self._given.get(robot.id)):
                self._taken_over.add(robot.id)
            if robot.id in self._taken_over or robot.state not in STANDING:
                self._idle_since.pop(robot.id, None)
                continue
            since = self._idle_since.setdefault(robot.id, now)
            if now - since >= PAUSE_AT_GOAL or robot.goal is None:
                # The planner may have received a goal that it does not report yet: send the same one again.
                cell = self._sent.get(robot.id, self._choose(fleet, goals))
                if cell is not None:
                    goals[robot.id] = self._sent[robot.id] = cell
        return goals

    def on_refused(self, robot: str) -> None:
        """Forget the goal of a robot that did not get it: the planner refused it, or there are tasks."""
        self._sent.pop(robot, None)

    def _choose(self, fleet: FleetModel, goals: dict[str, int]) -> int | None:
        if fleet.map is None:
            return None
        taken = {*fleet.blocked, *fleet.pending, *goals.values()}
        for robot in fleet.robots:
            taken.update(cell for cell in (robot.goal, robot.cell) if cell is not None)
        cells = range(fleet.map.rows * fleet.map.columns) if self._among is None else self._among
        free = [cell for cell in cells if cell not in taken]
        return self._rng.choice(free) if free else None


async def send_goals(station: StationClient, chooser: RandomGoals, *, has_manager: bool) -> list[str]:
    """Send the goals that are due; return the robots that got one.

    Args:
        station: The station's API.
        chooser: Chooses the goals.
        has_manager: Whether a fleet manager gives tasks to the robots.

    Raises:
        StationUnavailableError: Station, planner or fleet manager cannot be reached.
        RequestRefusedError: The station does not tell the fleet's state.
    """
    sent = []
    for robot, cell in chooser.update(await station.fleet(), time.monotonic()).items():
        # Asked each time: a goal that is set by hand would hold the task that a robot has just got.
        if has_manager and await station.has_open_tasks():
            chooser.on_refused(robot)
            continue
        try:
            await station.set_goal(robot, cell)
        except RequestRefusedError:
            chooser.on_refused(robot)
        else:
            sent.append(robot)
    return sent


async def send_random_goals(
    station: StationClient,
    chooser: RandomGoals,
    say: Callable[[str], None],
    *,
    has_manager: bool,
) -> None:
    """Send random goals until cancelled.

    Args:
        station: The station's API.
        chooser: Chooses the goals.
        say: Prints a line for the user.
        has_manager: Whether a fleet manager gives tasks to the robots.
    """
    told = frozenset[str]()
    while True:
        with contextlib.suppress(StationUnavailableError):
            await send_goals(station, chooser, has_manager=has_manager)
        for robot in sorted(chooser.taken_over - told):
            say(f"{robot} is yours now: it gets no more random goals")
        told = chooser.taken_over
        await asyncio.sleep(POLL_S)
