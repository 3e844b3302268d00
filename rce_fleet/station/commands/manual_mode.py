"""The mode of a robot that a person drives: manual meanwhile, and its own mode again afterwards."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING

from rce_fleet.station.commands.manual_watch import MANUAL, ManualWatch
from rce_fleet.station.commands.owed_modes import OwedMode, OwedModes
from rce_fleet.station.planner_client import PlannerError

if TYPE_CHECKING:
    from rce_fleet.station.fleet_link import FleetLink
    from rce_fleet.station.view import FleetView

_log = logging.getLogger(__name__)

AUTOMATIC = "automatic"
SHOWN_WAIT_S = 2.0
"""How long the view may take to show a mode that the planner accepted."""
LOOK_EVERY_S = 2.0
"""How often robots are looked for that are manual although they are not driven any more."""
_POLL_S = 0.05
_ASK_AGAIN_S = 0.5


class ManualHold:
    """A robot that is in the mode ``manual`` while a person drives it.

    Args:
        fleet: Asks the planner.
        view: Knows the robot's mode.
        robot: The robot.
        user: Who drives it.
    """

    def __init__(self, fleet: FleetLink, view: FleetView, robot: str, user: str) -> None:
        self._fleet = fleet
        self._view = view
        self._robot = robot
        self._user = user
        self._watch = ManualWatch(view, robot)

    async def begin(self) -> None:
        """Ask the planner for ``manual``.

        Raises:
            PlannerError: The planner refuses, or does not answer.
        """
        watch = ManualWatch(self._view, self._robot)
        await self._fleet.set_mode(self._robot, MANUAL, reason=f"driven by {self._user}", user=self._user)
        watch.accept(_now())
        self._watch = watch

    @property
    def why_not(self) -> str:
        """Why the robot must stand now, for its driver; empty: it may drive."""
        if self._watch.is_forgotten:
            return "the planner was restarted and is asked for the mode manual"
        mode = self.other_mode
        return f"{self._robot} is {mode} now: another user or a program drives it" if mode else ""

    @property
    def other_mode(self) -> str:
        """The mode that was set meanwhile, by a person or a program; empty: none."""
        return self._watch.other_mode(_now()) if self._fleet.knows_modes else ""

    async def until_other_mode(self) -> str:
        """Wait until another mode is set, and return why driving ends.

        A planner that was restarted is asked for ``manual`` again.
        """
        while not self.other_mode:
            if self._watch.is_forgotten:
                with suppress(PlannerError):  # it may not know the robot yet
                    await self.begin()
                await asyncio.sleep(_ASK_AGAIN_S)
            else:
                await asyncio.sleep(_POLL_S)
        return self.why_not


class ManualModes:
    """Puts robots into the mode ``manual``, and back.

    Args:
        fleet: Asks the planner.
        view: Knows the robots' modes.
        owed: The modes that robots shall have again; in memory only if None.
    """

    def __init__(self, fleet: FleetLink, view: FleetView, owed: OwedModes | None = None) -> None:
        self._fleet = fleet
        self._view = view
        self._owed = owed or OwedModes()
        self._driven: set[str] = set()
        self._settling = asyncio.Lock()
        """A request for the mode of before must not end the mode of the next one who drives the robot."""
        self._told: set[str] = set()
        """Robots of which an event told that their mode was not set again."""

    async def run(self) -> None:
        """Restore modes until cancelled, after a crash of the station or while the planner was away."""
        while True:
            for robot in self._owed.robots:
                async with self._settling:
                    if robot not in self._driven:
                        await self._settle(robot)
            await asyncio.sleep(LOOK_EVERY_S)

    @asynccontextmanager
    async def manual(self, robot: str, user: str) -> AsyncIterator[ManualHold]:
        """Have a robot in the mode ``manual`` while the block runs, then in the mode that it had before.

        A mode that is set meanwhile, by a person or a program, stays. If the planner does not set the mode
        of before, an event says so.

        Args:
            robot: The robot.
            user: Who drives it.

        Raises:
            PlannerError: The planner refuses ``manual``, or does not answer.
        """
        async with self._settling:
            self._driven.add(robot)
        try:
            await self._owe(robot, user)
            hold = ManualHold(self._fleet, self._view, robot, user)
            is_accepted = False
            try:
                await hold.begin()
                is_accepted = True
                yield hold
            finally:
                is_manual = is_accepted or self._view.mode_of(robot) == MANUAL
                if is_manual and hold.other_mode in ("", self._owed_mode(robot)):
                    await self._restore(robot)
                else:
                    self._owed.forget(robot)
                await self._save()
        finally:
            self._driven.discard(robot)

    async def _owe(self, robot: str, user: str) -> None:
        """Keep the mode that a robot has before it is driven; one that is manual has none of its own."""
        own, known = self._view.own_mode_of(robot), self._owed.get(robot)
        if own == MANUAL and known is not None:
            own = known.mode
        if own != MANUAL:
            self._owed.owe(robot, OwedMode(mode=own, user=user))
            await self._save()

    def _owed_mode(self, robot: str) -> str:
        """Return the mode that a robot shall have again; empty: none is owed."""
        owed = self._owed.get(robot)
        return "" if owed is None else owed.mode

    async def _settle(self, robot: str) -> None:
        """Restore the mode of a robot that is not driven, if it still is manual."""
        owed, shown = self._owed.get(robot), self._view.mode_of(robot)
        if owed is None or not shown or not self._fleet.knows_modes:
            return
        if shown != MANUAL:
            self._owed.forget(robot)
        elif await self._restore(robot):
            text = f"{robot} is {owed.mode} again, as before it was driven by {owed.user}"
            self._fleet.take_event(text, "good")
        await self._save()

    async def _restore(self, robot: str) -> bool:
        """Give a robot its own mode again, if one is owed; return whether it has it."""
        owed = self._owed.get(robot)
        if owed is None:
            return False
        reason = "" if owed.mode == AUTOMATIC else f"as before it was driven by {owed.user}"
        try:
            await self._fleet.set_mode(robot, owed.mode, reason=reason, user=owed.user)
        except PlannerError as error:
            if robot not in self._told:
                self._told.add(robot)
                self._fleet.take_event(f"{robot} stays manual; it was {owed.mode} before: {error}", "bad")
            return False
        for _ in range(round(SHOWN_WAIT_S / _POLL_S)):
            if self._view.mode_of(robot) != MANUAL:
                self._owed.forget(robot)
                self._told.discard(robot)
                return True
            await asyncio.sleep(_POLL_S)
        return False

    async def _save(self) -> None:
        try:
            await asyncio.to_thread(self._owed.save)
        except OSError as error:
            _log.error("the modes of robots are not kept for a restart of the station: %s", error)


def _now() -> float:
    return asyncio.get_running_loop().time()
