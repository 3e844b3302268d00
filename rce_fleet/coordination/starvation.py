"""Finds robots that would never reach their goals, or wait too long. Pure.

A robot with a goal that can be reached waits for a bounded number of plans:

- If its path ends before its goal, because a plan was incomplete or taken over only in part, it gets another
  path, without waiting for the others to come to rest.
- If no path led to its goal because of a robot that took no part in plans, it gets another try as soon as
  that robot leaves a cell.
- If others wait to pass through the cell in which it has arrived, it makes room for them after ``GIVE_WAY``
  seconds, and comes back, unless it was sent elsewhere meanwhile. If that was in vain, because another robot
  has to come out again for it, one plan is made for all.
- If it has stood in its cell for ``patience`` seconds although it has a path, one plan is made for all, in
  which it is the most urgent robot. PIBT brings the most urgent robot nearer to its goal with the first step
  (Okumura et al., "Priority Inheritance with Backtracking for Iterative Multi-agent Path Finding", 2022,
  lemma 1), so it waits only for the robots that make room for it. Of several such robots the one that has
  stood longest is first.

Urgency otherwise is the age of the goal, so a robot that others pushed aside again and again is the most
urgent one in the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.coordination.robot import Phase

if TYPE_CHECKING:
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord
    from rce_fleet.coordination.settings import FleetSettings

LOOK_EVERY = 1.0
"""Seconds between two looks at all robots."""
TRY_AGAIN = 5.0
"""Seconds between two tries to lengthen the path of a robot that ends before its goal."""
GIVE_WAY = 15.0
"""Seconds for which a robot rests in its goal although others wait to pass."""
MOST_URGENT = 1_000_000
"""Urgency of a robot that has stood too long, without the seconds; more than the age of any goal."""


@dataclass(frozen=True, slots=True)
class Need:
    """What robots that wait need.

    Attributes:
        paths: Robots that need new paths.
        plan: Whether one plan for all is needed.
    """

    paths: frozenset[str] = frozenset()
    plan: bool = False


class StarvationGuard:
    """Looks for robots that wait in vain.

    Args:
        state: The fleet; is only read.
        settings: Has ``patience``.
    """

    def __init__(self, state: FleetState, settings: FleetSettings) -> None:
        self._state = state
        self._settings = settings
        self._looked_at = -inf
        self._planned_at = -inf
        self._tried: dict[str, float] = {}
        self._hinders_since: dict[str, float] = {}
        self._gave_way: dict[str, set[tuple[float, str, float]]] = {}
        """For whom robots made room last, with the times at which they and the others were sent to their
        goals."""
        self._obstacles: frozenset[int] = frozenset()

    def note_request(self) -> None:
        """Note that a plan is requested: robots that take no part now are obstacles in it."""
        self._obstacles |= self._claims_of_inactive()

    def look(self, now: float) -> Need:
        """Return what robots need; to be called with each tick at which no plan is under way."""
        paths = self._with_way_opened()
        if now - self._looked_at < LOOK_EVERY:
            return Need(frozenset(paths))
        self._looked_at = now
        in_the_way = self._in_the_way(now)
        paths |= self._cut_short(now) | in_the_way
        is_starving = self._make_room_again(in_the_way) or any(
            stood_for(self._state, record, now) >= self._settings.patience
            for record in self._state.robots.values()
        )
        has_plan = now - self._planned_at < self._settings.patience
        if not is_starving or has_plan or not self._state.ledger.ordered:
            return Need(frozenset(paths))
        self._planned_at = now
        return Need(frozenset(paths), plan=True)

    def _with_way_opened(self) -> set[str]:
        """Return the robots without a way, if another robot has left a cell in which it was an obstacle."""
        obstacles = self._claims_of_inactive()
        has_left, self._obstacles = bool(self._obstacles - obstacles), obstacles
        if not has_left:
            return set()
        return {robot for robot, record in self._state.robots.items() if record.unreachable}

    def _claims_of_inactive(self) -> frozenset[int]:
        claims = self._state.ledger.claims
        return frozenset(
            cell
            for robot, record in self._state.robots.items()
            if record.phase is not Phase.ACTIVE
            for cell in claims(robot)
        )

    def _cut_short(self, now: float) -> set[str]:
        """Return robots that rest at the end of their paths, away from goals that can be reached."""
        state = self._state
        found = {
            robot
            for robot, record in state.robots.items()
            if record.phase is Phase.ACTIVE
            and record.goal is not None
            and not record.unreachable
            and robot not in state.index.under_way
            and state.ledger.end_of_grant(robot) != record.goal
        }
        due = {robot for robot in found if now - self._tried.get(robot, -inf) >= TRY_AGAIN}
        self._tried = {robot: now if robot in due else self._tried[robot] for robot in found}
        return due

    def _in_the_way(self, now: float) -> set[str]:
        """Return robots that have rested in their goals for long while others wait to pass."""
        state = self._state
        if not state.ledger.ordered:
            return set()
        self._hinders_since = {
            robot: self._hinders_since.get(robot, now)
            for robot, record in state.robots.items()
            if record.phase is Phase.ACTIVE
            and record.goal is not None
            and state.ledger.route(robot) == [record.goal]
            and state.ledger.occupied(record.goal, robot)
        }
        due = {robot for robot, since in self._hinders_since.items() if now - since >= GIVE_WAY}
        for robot in due:
            self._hinders_since[robot] = now
        return due

    def _make_room_again(self, robots: set[str]) -> bool:
        """Return whether one of the robots made room for the same other one before; note that they do now."""
        state, again = self._state, False
        for robot in robots:
            others = state.ledger.visitors(state.ledger.route(robot)[0]) - {robot}
            pairs = {(state.robots[robot].goal_at, other, state.robots[other].goal_at) for other in others}
            again |= not pairs.isdisjoint(self._gave_way.get(robot, ()))
            self._gave_way[robot] = pairs
        for robot in self._gave_way.keys() - state.robots.keys():
            del self._gave_way[robot]
        return again


def stood_for(state: FleetState, record: RobotRecord, now: float) -> float:
    """Return for how many seconds a robot has stood with a path to its goal and no cell to drive to."""
    if record.phase is not Phase.ACTIVE or record.goal is None or record.unreachable or not record.centred:
        return 0.0
    if len(state.ledger.granted(record.id)) != 1 or state.ledger.length(record.id) == 1:
        return 0.0
    return max(0.0, now - max(record.still_since(), record.goal_at))


def urgency_of(state: FleetState, record: RobotRecord, settings: FleetSettings, now: float) -> int:
    """Return how urgent a robot is in a plan for all; 0 for a robot without a goal."""
    if record.goal is None:
        return 0
    stood = stood_for(state, record, now)
    if stood >= settings.patience:
        return MOST_URGENT + min(int(stood), MOST_URGENT)
    return min(max(int(now - record.goal_at), 0), MOST_URGENT - 1)
