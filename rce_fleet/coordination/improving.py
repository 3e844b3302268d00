"""Better paths for robots that drive, made by the planner's process in the time that is left.

Like new paths for some robots (see :mod:`rce_fleet.coordination.rerouting`) they are found on a copy of the
ledger, among the visits of all, and entered between these. Granted cells stay as they are. The result is used
only if all that the copy holds is still true: then it is one order of steps, in which no robots wait for each
other in a circle. Nothing is granted while the process searches, which is for a twentieth of a second. A late
answer is ignored, and so is one that a blocked cell, or a robot that fell out, made useless.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from rce_fleet.coordination.rerouting import (
    Rerouting,
    adopt_rerouting,
    copied_robots,
    motion_of,
    paths_as_tuples,
    weighted_graph,
)
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.starvation import MOST_URGENT
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.path_improvement import improved
from rce_fleet.planning.planner import DEFAULT_PLANNER

if TYPE_CHECKING:
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.replanning import PlanRequest
    from rce_fleet.coordination.settings import FleetSettings

EVERY = 1.0
"""Seconds between two improvements."""
_LATE = 1.0
"""Seconds after its time for which the process is waited for: it may be stopped, and the robots stand."""
_FEWEST = 2
"""One robot alone has its shortest path already."""


class Improving:
    """Decides when paths are improved, and whether the result is used.

    Attributes:
        is_due: Whether paths changed since the last improvement that found nothing more.

    Args:
        state: The fleet; its ledger is changed.
        settings: Has the planner and ``improve_seconds``.
    """

    def __init__(self, state: FleetState, settings: FleetSettings) -> None:
        self._state = state
        self._seconds = settings.improve_seconds
        self._is_on = settings.improve_seconds > 0 and settings.planner == DEFAULT_PLANNER
        self.is_due = False
        self._asked_at = -inf
        self._versions: dict[str, int] = {}
        self._map_version = -1

    def may_begin(self, now: float) -> bool:
        """Return whether paths are to be improved now, if the planner has nothing else to do."""
        is_time = self.is_due and now - self._asked_at >= EVERY
        return self._is_on and is_time and len(self._state.index.under_way) >= _FEWEST

    def begin(self, request: PlanRequest, now: float) -> None:
        """Note the state of which a request has a copy."""
        self._asked_at = now
        self._versions = {robot: self._state.ledger.version(robot) for robot in request.robots}
        self._map_version = self._state.map_version

    def give_up(self, now: float) -> bool:
        """Return whether the answer to the newest request is late and not waited for any longer."""
        is_late = now - self._asked_at > self._seconds + _LATE
        if is_late:
            self.is_due = False
        return is_late

    def take(self, request: PlanRequest, found: Rerouting) -> set[str]:
        """Enter better paths into the ledger, unless the state has changed since the request.

        Returns:
            Robots that need new paths: zones do not allow all of theirs.
        """
        holds = self.holds(request) and self._has_goals(request, found)
        # After a gain there may be more to gain; what was found for another state is looked for again.
        self.is_due = bool(found.robots) or not holds
        if not found.robots or not holds:
            return set()
        return adopt_rerouting(self._state, request, found, self._versions)

    def holds(self, request: PlanRequest) -> bool:
        """Return whether cells and paths are still those of the request's copy."""
        state = self._state
        if state.map_version != self._map_version:
            return False
        for robot, start in zip(request.robots, request.starts, strict=True):
            record = state.robots.get(robot)
            if record is None or record.phase is not Phase.ACTIVE:
                return False
            if state.ledger.version(robot) != self._versions[robot]:
                return False
            if state.ledger.end_of_grant(robot) != start:
                return False
        known, blocked = frozenset(request.robots), frozenset(request.blocked)
        return all(robot in known or state.ledger.claims(robot) <= blocked for robot in state.robots)

    def _has_goals(self, request: PlanRequest, found: Rerouting) -> bool:
        """Return whether the goals of robots with better paths are still those of the request."""
        robots = self._state.robots
        return all(robots[request.robots[index]].goal == request.goals[index] for index in found.robots)


def compute_improvement(request: PlanRequest) -> Rerouting:
    """Return better paths for robots of the request's copy; none where nothing better was found."""
    copy = request.copy
    assert copy is not None
    grid = GridMap(request.rows, request.columns, blocked=frozenset(request.blocked))
    graph, own_costs = weighted_graph(request, grid)
    found = improved(
        graph,
        copied_robots(request, copy),
        seconds=request.improve_seconds,
        effort=request.effort,
        seed=request.seed,
        forbidden={index: frozenset(cells) for index, cells in request.forbidden} or None,
        own_costs=own_costs,
        motion=motion_of(request),
        urgent=[index for index, urgency in enumerate(request.urgency) if urgency >= MOST_URGENT],
    )
    return Rerouting(True, tuple(found.paths), paths_as_tuples(found.paths))
