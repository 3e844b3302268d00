"""The planner's modes of robots that an emergency stop holds: stopped, and their own again afterwards.

A stop reaches robots without the planner, but the planner must get to know of it: it would send a robot again
and again that does not move, and the manager would take the robot's task away after a while.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from rce_fleet.station.commands.manual_mode import AUTOMATIC
from rce_fleet.station.commands.manual_watch import MANUAL
from rce_fleet.station.commands.owed_modes import OwedMode, OwedModes
from rce_fleet.station.planner_client import PlannerError, PlannerUnavailableError
from rce_fleet.station.private_files import fleet_file

if TYPE_CHECKING:
    from rce_fleet.station.commands.control import RobotControl
    from rce_fleet.station.fleet_link import FleetLink
    from rce_fleet.station.view import FleetView

_log = logging.getLogger(__name__)

PAUSED, STOPPED = "paused", "stopped"
FLEET = ""
"""Stands for the whole fleet where modes are by robot."""
LOOK_EVERY_S = 2.0
"""How often stops and modes are compared; at once after an order."""
SHOWN_WAIT_S = 10.0
"""How long the view may take to show a mode that the planner accepted."""


def stop_modes_file(folder: Path, fleet: str) -> Path:
    """Return the file of the modes that a fleet's stopped robots shall have again.

    Args:
        folder: The folder.
        fleet: What tells the fleet from others.
    """
    return fleet_file(folder, "stop-modes", fleet)


class StopModes:
    """Has the planner know which robots are stopped.

    A stop of all robots is the fleet's mode ``stopped``, so that it is one request; once single robots of it
    are released, the others have the mode of their own.

    Args:
        fleet: Asks the planner.
        view: Knows the modes.
        control: Knows who is stopped.
        owed: The modes that robots, and the fleet, shall have again; in memory only if None.
    """

    def __init__(
        self, fleet: FleetLink, view: FleetView, control: RobotControl, owed: OwedModes | None = None
    ) -> None:
        self._fleet = fleet
        self._view = view
        self._control = control
        self._owed = owed or OwedModes()
        self._changed = asyncio.Event()
        self._set_at: dict[str, float] = {}
        """When the planner accepted a mode last, for each robot."""
        self._free_since: dict[str, float] = {}
        """Since when a released robot is shown in another mode than stopped, though none was set."""
        self._paid: set[str] = set()
        """Robots whose mode of before the planner has accepted."""
        self._told: set[str] = set()
        """Robots of which an event told that the planner refuses their mode."""

    def wake(self) -> None:
        """Compare at once: robots were stopped or released."""
        self._changed.set()

    async def run(self) -> None:
        """Bring modes and stops together, until cancelled."""
        while True:
            self._changed.clear()
            if self._fleet.knows_modes and self._view.state is not None:
                with suppress(PlannerUnavailableError):
                    await self._settle()
                await self._save()
            with suppress(TimeoutError):
                async with asyncio.timeout(LOOK_EVERY_S):
                    await self._changed.wait()

    async def _settle(self) -> None:
        """Stop first, then release: a robot that is stopped must not drive in between.

        Raises:
            PlannerUnavailableError: The planner does not answer.
        """
        robots = self._view.robot_ids()
        stopped = {robot: by for robot, by in self._control.stopped.items() if self._view.knows(robot)}
        all_by = self._control.fleet_stopped_by
        if all_by is not None and len(stopped) == len(robots):
            await self._stop_fleet(robots, all_by)
            return
        for robot, by in stopped.items():
            await self._stop(robot, by)
        await self._release(FLEET, self._view.mode)
        for robot in self._owed.robots:
            if robot not in stopped and self._view.knows(robot) and self._view.mode != STOPPED:
                await self._release(robot, self._view.mode_of(robot))

    async def _stop_fleet(self, robots: list[str], user: str) -> None:
        if self._view.mode == STOPPED:
            return
        for robot in robots:  # under a fleet that is stopped, the view does not show that they are paused
            if self._view.own_mode_of(robot) == PAUSED:
                self._owed.owe(robot, OwedMode(mode=PAUSED, user=user))
        await self._set_stopped(FLEET, self._view.mode, user)

    async def _stop(self, robot: str, user: str) -> None:
        mode = self._view.mode_of(robot)
        is_by_fleet = mode == STOPPED == self._view.mode and self._owed.get(FLEET) is not None
        if mode in (AUTOMATIC, PAUSED) or is_by_fleet:
            await self._set_stopped(robot, self._view.own_mode_of(robot), user)

    async def _set_stopped(self, robot: str, mode: str, user: str) -> None:
        # One that was paused meanwhile must not drive at its release.
        owed = self._owed.get(robot)
        if owed is None or (mode == PAUSED != owed.mode):
            self._owed.owe(robot, OwedMode(mode=mode, user=user))
            await self._save()
        self._paid.discard(robot)
        await self._set(robot, STOPPED, "", user)

    async def _release(self, robot: str, shown: str) -> None:
        """Give a robot, or the fleet, its mode of before; one that a person set meanwhile stays.

        A planner that has just started shows its own modes until the manager gives it those that it had.
        """
        owed = self._owed.get(robot)
        if owed is None or shown in ("", MANUAL):
            return
        if shown == STOPPED:
            reason = "" if owed.mode == AUTOMATIC else f"as before the emergency stop by {owed.user}"
            self._free_since.pop(robot, None)
            if await self._set(robot, owed.mode, reason, owed.user):
                self._paid.add(robot)
        elif robot in self._paid or self._is_shown_for_long(robot):
            self._owed.forget(robot)
            self._told.discard(robot)
            self._paid.discard(robot)
            self._free_since.pop(robot, None)

    def _is_shown_for_long(self, robot: str) -> bool:
        """Return whether a released robot is in another mode than stopped, not just before or after it."""
        since = self._free_since.setdefault(robot, _now())
        return _now() - max(since, self._set_at.get(robot, -inf)) > SHOWN_WAIT_S

    async def _set(self, robot: str, mode: str, reason: str, user: str) -> bool:
        """Set a mode; return whether the planner has accepted it."""
        try:
            await self._fleet.set_mode(robot, mode, reason=reason, user=user)
        except PlannerUnavailableError:
            raise
        except PlannerError as error:
            if robot not in self._told:
                self._told.add(robot)
                what = robot or "the fleet"
                self._fleet.take_event(f"the planner does not take that {what} is {mode}: {error}", "bad")
            return False
        self._set_at[robot] = _now()
        return True

    async def _save(self) -> None:
        if self._owed.is_saved:
            return
        try:
            await asyncio.to_thread(self._owed.save)
        except OSError as error:
            _log.error("the modes of stopped robots are not kept for a restart of the station: %s", error)


def _now() -> float:
    return asyncio.get_running_loop().time()
