"""Which frontier a robot drives to next, and when a floor is explored."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from math import hypot, inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.navigation.exploration.frontiers import Frontier, FrontierParameters, FrontierSearch

if TYPE_CHECKING:
    from collections.abc import Iterator

SAME = 0.25
"""Frontiers whose middles are nearer than this count as the same one, metres; explore_lite: five cells."""
STILL_THERE = 0.5
"""A goal is kept while a frontier has a point this near to its middle, metres."""
PROGRESS = 0.1
"""A robot that came nearer by this has made progress, metres."""
TIME_JUMP = 1.0
"""Time that goes back by more than this began anew, with a simulation or a bag, seconds."""
MAP_WAIT = 10.0
"""So long the last goal's scans may take until they are on the map, seconds: gmapping draws every five."""


class Action(Enum):
    """What to do."""

    DRIVE = "drive"
    """Send the robot to :attr:`Explorer.target`, in place of the goal before."""
    KEEP = "keep"
    """Nothing: the robot is on its way, or the map of what it saw is still to come."""
    DONE = "done"
    """The floor is explored: stop."""


@dataclass(frozen=True, slots=True)
class ExplorerParameters(FrontierParameters):
    """How a floor is explored; names and defaults as in explore_lite.

    Attributes:
        progress_timeout: A goal is given up if the robot comes no nearer to it for so long, seconds.
    """

    progress_timeout: float = field(default=30.0, metadata={"above": 0})


class Explorer:
    """Decides where a robot drives. Every goal that ends, however it ends, is not chosen again.

    Hence an exploration ends: the frontiers of a floor of finite size can be chosen finitely often.

    Args:
        parameters: How to explore.

    Attributes:
        target: The frontier that the robot drives to; None if it has no goal.
        over: Middles of the frontiers that are not chosen any more, with the reason.
        goals: How many goals were chosen.
    """

    def __init__(self, parameters: ExplorerParameters) -> None:
        self.parameters = parameters
        self.target: Frontier | None = None
        self.over: list[tuple[tuple[float, float], str]] = []
        self.goals = 0
        self._nearest = inf
        self._progress_at = 0.0
        self._ended_at = self._now = -inf

    def update(self, search: FrontierSearch, drawn_at: float, now: float) -> Action:
        """Return what to do with the newest map.

        Args:
            search: The frontiers of the map.
            drawn_at: When the map came, seconds.
            now: Seconds; on the same clock.
        """
        if now < self._now - TIME_JUMP:
            self._progress_at, self._ended_at = now, -inf
        self._now = now
        if self.target is not None:
            held = self._follow(self.target, search, now)
            if held is not None:
                return held
        best = next(self._open(search), None)
        if best is None:
            self.target = None
            waits = drawn_at <= self._ended_at and now - self._ended_at < MAP_WAIT
            return Action.KEEP if waits or search.reason else Action.DONE
        return self._choose(best, now)

    def reached(self, now: float) -> None:
        """Note that the robot is at its goal: the frontier is seen, or will not be seen from there."""
        self._end("was visited", now)

    def failed(self, reason: str, now: float) -> None:
        """Note that the goal cannot be reached."""
        self._end(reason, now)

    def forget(self) -> None:
        """Forget the goal, without a judgement on its frontier: it was cancelled."""
        self.target = None

    def is_over(self, frontier: Frontier) -> bool:
        """Return whether a frontier is not chosen any more."""
        x, y = frontier.middle
        return any(hypot(x - at[0], y - at[1]) < SAME for at, _ in self.over)

    # Inside

    def _open(self, search: FrontierSearch) -> Iterator[Frontier]:
        return (one for one in search.frontiers if not self.is_over(one))

    def _follow(self, target: Frontier, search: FrontierSearch, now: float) -> Action | None:
        """Return what to do while the target is still a frontier; None if another one is to be chosen."""
        if search.reason:
            return Action.KEEP
        x, y = target.middle
        near = [one for one in self._open(search) if _apart(one, x, y) < STILL_THERE]
        if not near:
            return None
        way = search.way_to(target.goal.x, target.goal.y)
        if way == inf:  # something was seen at the goal
            self.target = min(near, key=lambda one: _apart(one, x, y))
            self.goals, self._nearest = self.goals + 1, self.target.way
            return Action.DRIVE
        if way < self._nearest - PROGRESS:
            self._nearest, self._progress_at = way, now
        elif now - self._progress_at > self.parameters.progress_timeout:
            self._end(f"no progress for {self.parameters.progress_timeout:g} s", now)
            return None
        return Action.KEEP

    def _choose(self, frontier: Frontier, now: float) -> Action:
        self.target = frontier
        self.goals += 1
        self._nearest, self._progress_at = inf, now
        return Action.DRIVE

    def _end(self, reason: str, now: float) -> None:
        if self.target is not None:
            self.over.append((self.target.middle, reason))
            self.target, self._ended_at = None, now


def _apart(frontier: Frontier, x: float, y: float) -> float:
    """Return the distance from a frontier to a point, metres."""
    return float(np.hypot(*(frontier.points - (x, y)).T).min())
