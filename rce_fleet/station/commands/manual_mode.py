"""The mode of a robot that a person drives: manual meanwhile, and its own mode again afterwards."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rce_fleet.station.planner_client import PlannerError

if TYPE_CHECKING:
    from rce_fleet.station.fleet_link import FleetLink
    from rce_fleet.station.view import FleetView

AUTOMATIC, MANUAL = "automatic", "manual"
SHOWN_WAIT_S = 2.0
"""How long the view may take to show a mode that the planner accepted."""
_POLL_S = 0.05


class ManualModes:
    """Puts robots into the mode ``manual``, and back.

    Args:
        fleet: Asks the planner.
        view: Knows the robots' modes.
    """

    def __init__(self, fleet: FleetLink, view: FleetView) -> None:
        self._fleet = fleet
        self._view = view
        self._owed: dict[str, str] = {}
        """Modes that robots should have again, and that the planner did not set."""

    @asynccontextmanager
    async def manual(self, robot: str, user: str) -> AsyncIterator[None]:
        """Have a robot in the mode ``manual`` while the block runs, then in the mode that it had before.

        A mode that is set meanwhile, by a person or a program, stays. If the planner does not set the mode
        of before, an event says so.

        Args:
            robot: The robot.
            user: Who drives it.

        Raises:
            PlannerError: The planner refuses ``manual``, or does not answer.
        """
        before = self._view.mode_of(robot)
        own = self._view.own_mode_of(robot)
        if own == MANUAL:
            own = self._owed.get(robot, MANUAL)
        is_accepted = False
        try:
            await self._fleet.set_mode(robot, MANUAL, reason=f"driven by {user}", user=user)
            is_accepted = True
            yield
        finally:
            shown = self._view.mode_of(robot)
            # The view may not show manual yet. It shows the mode of before then, which may be set again.
            if own != MANUAL and (shown == MANUAL or (is_accepted and shown == before)):
                await self._restore(robot, own, user)

    async def _restore(self, robot: str, mode: str, user: str) -> None:
        self._owed[robot] = mode
        reason = "" if mode == AUTOMATIC else f"as before it was driven by {user}"
        try:
            await self._fleet.set_mode(robot, mode, reason=reason, user=user)
        except PlannerError as error:
            self._fleet.take_event(f"{robot} stays manual; it was {mode} before: {error}", "bad")
            return
        for _ in range(round(SHOWN_WAIT_S / _POLL_S)):
            if self._view.mode_of(robot) != MANUAL:
                del self._owed[robot]
                break
            await asyncio.sleep(_POLL_S)
