"""Enters one plan for all robots into the ledger; see :mod:`rce_fleet.coordination.replanning`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.full_zones import note_unreachable
from rce_fleet.coordination.indexes import is_stopping
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.rerouting import NO_CELL
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.zone_rules import ZoneRules

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.replanning import PlanRequest, PlanResult

NO_WAY_PAST = "no way past the other robots was found yet: the planner looks again, longer each time"
"""Why a robot has no path after a plan for all that is not complete ..."""
NO_PLAN_EXISTS = "the robots cannot pass each other: no plan brings all to their goals; send one elsewhere"
"""... and if everything was tried."""


class PlanAdoption:
    """Enters a plan's routes into the ledger, a part at a time.

    The state may have changed since the request, and may change between two parts. A robot that is not active
    any more, was granted other cells or has another goal gets no route, or no more of it, and a route ends
    before a cell that the robot may not enter any more. That is safe, because robots drive only on granted
    cells, and the ledger checks each grant; but these robots need other paths, see :meth:`robots_left`.

    Attributes:
        request: The plan's request.
        result: The plan.

    Args:
        state: The fleet; its ledger and the robots' ``unreachable``, ``full_zone`` and ``no_path`` change.
        request: The plan's request.
        result: The plan.
        zones: Revision of the zones that the plan keeps to.
    """

    def __init__(self, state: FleetState, request: PlanRequest, result: PlanResult, zones: int) -> None:
        self._state = state
        self.request = request
        self.result = result
        self._zones = zones
        self._next = 0
        self._present: list[str | None] = []
        unreachable, forbidden = frozenset(result.unreachable), dict(request.forbidden)
        starts = {}
        for index, robot in enumerate(request.robots):
            is_present = self._wants(index) and state.ledger.end_of_grant(robot) == request.starts[index]
            self._present.append(robot if is_present else None)
            if not is_present:
                continue
            starts[robot] = request.starts[index]
            barred = forbidden.get(index, ())
            record, is_unreachable = state.robots[robot], index in unreachable
            note_unreachable(state, record, is_unreachable=is_unreachable, barred=barred)
        state.ledger.begin_plan(starts, ordered=result.ordered)
        self._versions = [state.ledger.version(robot) for robot in request.robots]

    def step(self, visits: int) -> bool:
        """Enter the next ``visits`` visits; return whether these were the last ones."""
        begin, end = self._next, self._next + visits
        self._next = end
        for index, robot in enumerate(self._present):
            if robot is not None and not self._is_on_plan(index):
                self._present[index] = None
        self._state.ledger.extend_plan(self._visits(begin, end))
        is_done = end >= len(self.result.cells)
        if is_done:
            self._explain()
        return is_done

    def robots_left(self, concerned: Iterable[str]) -> set[str]:
        """Return the robots that need another path after the last step.

        They are those whose route was cut, or leads through cells of a robot that fell out since the request.
        One that is only stopping has its turn soon: the others wait for it.

        Args:
            concerned: Robots that needed one since the request; the plan may have a path to their goals.
        """
        state, ledger = self._state, self._state.ledger
        left = set(concerned)
        left.difference_update(robot for robot in self._present if robot and self._has_path(robot))
        for robot, present in zip(self.request.robots, self._present, strict=True):
            record = state.robots.get(robot)
            if present is None and record is not None and record.phase is Phase.ACTIVE:
                left.add(robot)
        obstacles = frozenset(self.request.blocked)
        for record in state.robots.values():
            is_driven = state.mode_of(record) is RobotMode.AUTOMATIC
            if record.phase is Phase.ACTIVE or (is_driven and is_stopping(record, ledger)):
                continue
            for cell in ledger.claims(record.id) - obstacles:
                left |= ledger.visitors(cell) - {record.id}
        return left

    def _has_path(self, robot: str) -> bool:
        """Return whether a robot has a path to its goal, which is open."""
        goal = self._state.robots[robot].goal
        is_open = goal is not None and not self._state.is_shut(goal)
        return is_open and self._state.ledger.route(robot)[-1:] == [goal]

    def _explain(self) -> None:
        """Note why robots have no path to their goals, if the plan has none although they can be reached."""
        result = self.result
        why = ""
        if result.failure:
            why = f"the planner made no plan: {result.failure}"
        elif not result.complete:
            why = NO_PLAN_EXISTS if result.impossible else NO_WAY_PAST
        for robot in filter(None, self._present):
            record = self._state.robots[robot]
            needs_none = record.goal is None or record.unreachable
            no_path = "" if needs_none or self._has_path(robot) else why
            if record.no_path != no_path:
                record.no_path = no_path
                self._state.touch(record)

    def _wants(self, index: int) -> bool:
        """Return whether a robot still takes part, with the goal that was planned for."""
        record = self._state.robots.get(self.request.robots[index])
        if record is None or record.phase is not Phase.ACTIVE:
            return False
        return (NO_CELL if record.goal is None else record.goal) == self.request.goals[index]

    def _is_on_plan(self, index: int) -> bool:
        robot = self.request.robots[index]
        return self._wants(index) and self._state.ledger.version(robot) == self._versions[index]

    def _visits(self, begin: int, end: int) -> Iterator[tuple[str, int, int]]:
        """Yield visits in order, as far as they are still possible."""
        state, present, result = self._state, self._present, self.result
        shut, ledger = state.shut, state.ledger
        rules = ZoneRules(state) if state.zones.revision != self._zones else None
        steps = result.steps or range(1, len(result.cells) + 1)
        parts = (result.visitors[begin:end], result.cells[begin:end], steps[begin:end])
        for index, cell, step in zip(*parts, strict=True):
            robot = present[index]
            if robot is None:
                continue
            if cell in shut or (rules and not rules.admit(robot, ledger.account(robot).route[-1], cell)):
                present[index] = None  # Its route ends here.
            else:
                yield robot, cell, step
