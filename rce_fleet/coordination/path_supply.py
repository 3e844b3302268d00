"""Supplies robots with paths: repairs of single paths, new paths for some, or one plan for all."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from rce_fleet.coordination.adoption import PlanAdoption
from rce_fleet.coordination.congestion import LearnedCosts
from rce_fleet.coordination.events import Instruction, MakePlan
from rce_fleet.coordination.improving import Improving
from rce_fleet.coordination.own_planner import OwnPlanner
from rce_fleet.coordination.repair import PathRepair
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, request_plan
from rce_fleet.coordination.rerouting import adopt_rerouting
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.search_time import SearchTime
from rce_fleet.coordination.starvation import StarvationGuard
from rce_fleet.coordination.waiting import find_deadlocks
from rce_fleet.coordination.zones import ZoneKind
from rce_fleet.planning.planner import BUILT_IN_PLANNERS, INDEPENDENT

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings

_LOOK_EVERY = 1.0
"""Seconds between two searches for robots that wait for each other."""
_BETWEEN = 0.1
"""Seconds between two searches before the next tick: what is blocked in one go is looked at together."""
_REPAIR_CELLS = 100_000
"""So many cells are searched for repairs in one tick, in about 40 ms; larger maps are for the process."""
_ALONE_CELLS = 50_000
"""The same for the planner ``dijkstra``, whose searches count costs; at least one robot has its turn ..."""
_MOST_ALONE = 50
"""... and at most so many."""
_LONGEST_WAITS = 2
"""However many robots stop one after another, a plan waits for them at most so often ``hold_timeout``."""


class PathSupply:
    """Decides which robots get new paths, and how.

    Attributes:
        outdated: Whether the state changed since the newest plan request so that a plan for all is needed.
        concerned: Robots that need a new path; the others keep theirs.

    Args:
        state: The fleet.
        settings: Sizes and times.
    """

    def __init__(self, state: FleetState, settings: FleetSettings) -> None:
        self._state = state
        self._settings = settings
        self.outdated = False
        self.concerned: set[str] = set()
        self._partial = False
        self._repair = PathRepair(state, settings)
        self._guard = StarvationGuard(state, settings)
        self._improving = Improving(state, settings)
        self._search_time = SearchTime(settings.plan_timeout)
        self._learned = LearnedCosts(state) if settings.learn_congestion else None
        self._is_alone = settings.planner == INDEPENDENT
        self._own = OwnPlanner(settings.planner)
        state.ledger.ordered = not self._is_alone
        self._looked_at = -inf
        self._is_due = False
        """Whether the robots concerned get paths before the next tick."""
        self._searched_at = -inf
        self._took_over = False
        """Whether paths were taken over with this event: their cells are granted before others are sought."""
        self._waits_since: float | None = None
        self._deadlocked: set[str] = set()
        self._users: dict[str, set[str]] = {}
        self._asked: PlanRequest | None = None
        self._asked_at = -inf
        self._zones = 0
        """Revision of the zones when the newest plan for all was requested."""
        self._versions: dict[str, int] = {}
        self._plans = 0
        self._adoption: PlanAdoption | None = None

    @property
    def is_quiet(self) -> bool:
        """Whether no plan is needed, requested or taken over: all that is possible can be granted."""
        return not self.outdated and self._asked is None

    @property
    def is_taking_over(self) -> bool:
        """Whether the rest of a plan follows with the next events."""
        return self._adoption is not None

    def require(self, robots: Iterable[str]) -> None:
        """Note that robots need new paths, and that the state changed since the newest plan request.

        While a plan for all is made, the others take it over as it is.
        """
        if self._can_repair():
            self.concerned.update(robots)
        else:
            self.outdated = True

    def _can_repair(self) -> bool:
        """Return whether single robots get new paths; otherwise one plan is always made for all."""
        return self._is_alone or (self._state.ledger.ordered and self._settings.repairs > 0)

    def take_plan(self, result: PlanResult, now: float) -> None:
        """Begin to take over the requested plan; ignore any other."""
        request = self._asked
        if request is None or request.number != result.number or self._adoption is not None:
            return
        if result.rerouting is not None:
            self._asked, self._took_over = None, True
            if request.improve_seconds:
                self.concerned |= self._improving.take(request, result.rerouting)
            elif result.rerouting.found:
                self._improving.is_due = True
                self.concerned |= adopt_rerouting(self._state, request, result.rerouting, self._versions)
            else:
                self.outdated = True
            return
        if result.failure and request.planner not in BUILT_IN_PLANNERS:
            self._own.note_failure(self._asked_at, now)
            self._asked = None
            self.outdated = True
            return
        if self.outdated and self._awaited(now):
            self._asked = None
            return
        self._waits_since = None
        self._adoption = PlanAdoption(self._state, request, result, self._zones)
        # After a plan that makes progress, request another; otherwise wait for a change.
        self._partial = not result.complete and bool(result.cells)

    def continue_plan(self, now: float) -> bool:
        """Take over the next part of a plan, if there is one; the part after it follows with the next event.

        Returns:
            Whether cells have to be granted although another plan is needed, so that robots make progress.
        """
        adoption = self._adoption
        if adoption is None or not adoption.step(self._settings.visits_per_step):
            return False
        self._search_time.note(adoption.request, adoption.result)
        self._improving.is_due = self._took_over = True
        self._asked = self._adoption = None
        left, self.concerned = adoption.robots_left(self.concerned), set()
        if left:
            self.require(left)
        return self.outdated and not self._awaited(now)

    def supply(self, now: float, *, is_tick: bool, at_once: bool = False) -> Instruction | None:
        """Find new paths for robots that need some, or return the request of a plan for all.

        Args:
            now: Time, seconds.
            is_tick: Whether the current event is a tick; single paths are found then.
            at_once: Whether they are found before the next tick, unless some were found just now.
        """
        took_over, self._took_over = self._took_over, False
        self._is_due = bool(self.concerned) and (self._is_due or at_once or took_over)
        if self._awaits_answer(now, looks=is_tick or at_once):
            return None
        if self._partial and not self._state.index.under_way:
            self.outdated = True
        if is_tick:
            self._look_at_waiting(now)
        is_due = is_tick or (self._is_due and now - self._searched_at >= _BETWEEN)
        if self.concerned and is_due and not took_over:
            self._is_due, self._searched_at = False, now
            self.outdated |= self._own.is_asked(now) or not self._can_repair()
            if not self.outdated:
                request = self._replan_concerned(now)
                self._improving.is_due = True
                self._state.refresh()
                if request is not None:
                    return request
        if self.outdated:
            return None if self._awaited(now) else self._ask(now)
        if is_tick and not self.concerned and self._improving.may_begin(now):
            return self._ask_for_better(now)
        return None

    def _look_at_waiting(self, now: float) -> None:
        """Note what robots need that wait."""
        if self._learned is not None:
            self._learned.look(now)
        self._look_for_deadlocks(now)
        self._look_for_room()
        need = self._guard.look(now)
        if need.paths:
            self.require(need.paths)
        self.outdated |= need.plan

    def _awaits_answer(self, now: float, *, looks: bool) -> bool:
        """Return whether the process has a request; better paths that are late or useless are not waited for.

        Args:
            now: Time, seconds.
            looks: Whether the robots' paths are compared with those that better ones are sought for.
        """
        asked = self._asked
        if asked is not None and asked.improve_seconds:
            needs_others = looks and (self.outdated or bool(self.concerned))
            if self._improving.give_up(now) or (needs_others and not self._improving.holds(asked)):
                self._asked = None
        return self._asked is not None

    def _ask_for_better(self, now: float) -> MakePlan:
        """Return a request to improve the paths that robots have."""
        self._asked = request_plan(self._state, self._settings, self._plans, now, improve=True)
        self._improving.begin(self._asked, now)
        self._plans += 1
        return MakePlan(self._asked)

    def _ask(self, now: float) -> MakePlan:
        self.concerned.clear()
        self._guard.note_request()
        planner = self._own.name_at(now)
        self._asked = request_plan(
            self._state,
            self._settings,
            self._plans,
            now,
            planner=planner,
            search_seconds=self._search_time.take(now),
        )
        self._asked_at = now
        self._zones = self._state.zones.revision
        self._plans += 1
        self.outdated = self._partial = False
        return MakePlan(self._asked)

    def _awaited(self, now: float) -> bool:
        """Return whether a plan has to wait for a robot that is stopping."""
        timeout = self._settings.hold_timeout
        told_at = self._state.index.last_stop()
        if told_at is None or now - told_at >= timeout:
            return False
        if self._waits_since is None:
            self._waits_since = now
        return now - self._waits_since < _LONGEST_WAITS * timeout

    def _replan_concerned(self, now: float) -> MakePlan | None:
        """Find new paths for the robots that need one; the others keep theirs.

        The planner ``dijkstra`` finds them for as many robots with each tick as the map's size allows.
        Otherwise a robot in the way of another may have to go first, so those that found none are tried
        again. If more robots need one than settings and map allow, or some find none, the planner's process
        looks for paths of all of them.
        """
        state, settings = self._state, self._settings
        # Those that have waited longest find their paths first.
        waiting = sorted(
            (
                robot
                for robot in self.concerned
                if (record := state.robots.get(robot)) is not None and record.phase is Phase.ACTIVE
            ),
            key=lambda robot: (state.robots[robot].goal_at, robot),
        )
        if self._is_alone and not state.ledger.ordered:
            turn = waiting[: min(_MOST_ALONE, max(_ALONE_CELLS // len(state.grid), 1))]
            self.concerned.difference_update(turn)
            for robot in turn:
                state.ledger.truncate(robot)
                self._repair.replan_alone(state.robots[robot])
            return None
        self.concerned.clear()
        while waiting and len(waiting) <= min(settings.repairs, _REPAIR_CELLS // len(state.grid)):
            effort = settings.repair_effort // len(waiting)
            left = [robot for robot in waiting if not self._repair.replan(state.robots[robot], effort)]
            if len(left) == len(waiting):
                break
            waiting = left
        return self._reroute(waiting, now) if waiting else None

    def _reroute(self, robots: list[str], now: float) -> MakePlan | None:
        """Return the request of new paths for some robots, unless one of them has to be planned with all."""
        state = self._state
        for robot in robots:
            start = state.ledger.end_of_grant(robot)
            if state.robots[robot].goal is None and start is not None and state.index.hindered.at({start}):
                self.outdated = True
                return None
        self._asked = request_plan(state, self._settings, self._plans, now, robots)
        self._versions = {robot: state.ledger.version(robot) for robot in self._asked.robots}
        self._plans += 1
        return MakePlan(self._asked)

    def _look_for_deadlocks(self, now: float) -> None:
        """Tell of robots that wait for each other, where cells are granted in no order."""
        state = self._state
        if state.ledger.ordered:
            if self._is_alone and not state.index.under_way and not self.concerned:
                state.ledger.ordered = False  # The plan that resolved a deadlock is done.
            self._tell_deadlocks({})
            return
        if now - self._looked_at < _LOOK_EVERY:
            return
        self._looked_at = now
        found = find_deadlocks(state)
        self._tell_deadlocks(found)
        if found and self._own.is_asked(now):
            self._own.note_failure(now, now)  # Its next plan would lead to the same deadlock.
        self.outdated |= bool(found) and (self._settings.resolve_deadlocks or not self._is_alone)

    def _tell_deadlocks(self, found: dict[str, str]) -> None:
        """Give robots that wait for each other the reason, and take it from those that do not any more."""
        for robot in self._deadlocked | found.keys():
            record = self._state.robots.get(robot)
            reason = found.get(robot, "")
            if record is not None and record.phase is Phase.ACTIVE and record.reason != reason:
                record.reason = reason
                self._state.touch(record)
        self._deadlocked = set(found)

    def _look_for_room(self) -> None:
        """Let robots that wait try again when one has left a limited zone."""
        state = self._state
        users = {zone.id: state.zone_users(zone) for zone in state.zones.of_kind(ZoneKind.LIMITED)}
        if any(before - users.get(name, set()) for name, before in self._users.items()):
            self.require(record.id for record in state.robots.values() if record.unreachable)
        self._users = users
