"""Whether a robot that a person drives is still manual, as far as the view shows. Pure."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce_fleet.station.view import FleetView

MANUAL = "manual"
SHOWN_WAIT_S = 10.0
"""How long the view may take to show ``manual`` after the planner accepted it."""


class ManualWatch:
    """Compares the mode of a robot with ``manual``; made before the planner is asked for it.

    Args:
        view: Knows the mode, and which run of the planner it is of.
        robot: The robot.
    """

    def __init__(self, view: FleetView, robot: str) -> None:
        self._view = view
        self._robot = robot
        self._accepted_at = inf
        self._before = view.mode_of(robot)
        self._run = view.planner_run
        self._is_shown = False

    def accept(self, now: float) -> None:
        """Note that the planner accepted ``manual``.

        Args:
            now: The station's clock, seconds.
        """
        self._accepted_at = now

    @property
    def is_forgotten(self) -> bool:
        """Whether the planner was restarted since it was asked: it does not know the mode."""
        return self._view.planner_run != self._run

    def other_mode(self, now: float) -> str:
        """Return the mode that a person or program set instead; empty: none.

        Until the view shows ``manual`` it may show the mode of before.

        Args:
            now: The station's clock, seconds.
        """
        shown = self._view.mode_of(self._robot)
        self._is_shown |= shown == MANUAL
        if shown in ("", MANUAL) or self.is_forgotten:
            return ""
        is_late = now - self._accepted_at > SHOWN_WAIT_S
        return shown if self._is_shown or is_late or shown != self._before else ""
