"""A new path for one robot, between the visits of the others, which keep theirs. Pure."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

from rce_fleet.coordination.full_zones import note_unreachable
from rce_fleet.coordination.path_search import FAR, Roads, Turns, costs_to, find_path, is_enclosed, moves_to
from rce_fleet.coordination.rerouting import heading_at_start
from rce_fleet.coordination.robot import Phase
from rce_fleet.planning.motion import Motion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord
    from rce_fleet.coordination.settings import FleetSettings

_FIELDS = 256
"""Distances to so many goals at most are kept while the map does not change ..."""
_FIELD_BYTES = 32_000_000
"""... as long as they take no more memory."""
_CELL_BYTES = array("i").itemsize


class PathRepair:
    """Finds new paths for single robots and enters them into the ledger.

    Args:
        state: The fleet; its ledger and the robots' ``unreachable`` and ``full_zone`` are changed.
        settings: What turns and stops cost.
    """

    def __init__(self, state: FleetState, settings: FleetSettings) -> None:
        self._state = state
        motion = Motion(settings.quarter_turn, settings.stop)
        self._turn_steps = motion.turn_steps.tolist() if motion.turn_steps.any() else None
        self._version = -1
        self._fields: dict[tuple[int, frozenset[int], frozenset[tuple[int, int]]], array[int]] = {}

    def replan(self, record: RobotRecord, effort: int) -> bool:
        """Give an active robot a new route beyond its granted cells; its old one may be its beginning.

        A robot without a goal, or with one that cannot be reached, stays where it is unless it is in the way.

        Args:
            record: The robot.
            effort: Places and times to try at most.

        Returns:
            Whether it has what it needs; if not, one plan for all has to be made.
        """
        state, ledger = self._state, self._state.ledger
        robot = record.id
        start = ledger.end_of_grant(robot)
        assert start is not None
        forbidden = state.forbidden(robot)
        goal = record.goal
        is_unreachable = goal is not None and not self._can_reach(start, goal, robot, forbidden)
        self._note_unreachable(record, is_unreachable=is_unreachable)
        if is_unreachable or goal is None:
            return self._stand_aside(record, start, forbidden, effort)
        if goal == start and not ledger.occupied(start, robot):
            ledger.truncate(robot)
            return True
        roads = self._roads(robot, forbidden)
        if self._find(record, goal, roads, self._field(goal, robot, forbidden), effort):
            return True
        if is_enclosed(start, goal, roads):
            # Only robots that take no part are in its way: a plan for all would find no path either.
            self._note_unreachable(record, is_unreachable=True)
            return self._stand_aside(record, start, forbidden, effort)
        return False

    def _stand_aside(self, record: RobotRecord, start: int, forbidden: frozenset[int], effort: int) -> bool:
        """Let a robot that has nowhere to go stay where its granted cells end, or make room there."""
        state, robot = self._state, record.id
        state.ledger.truncate(robot)
        is_in_the_way = bool(state.ledger.occupied(start, robot) or state.index.hindered.at({start}))
        if not is_in_the_way and start not in forbidden and not state.is_shut(start):
            record.rest = start
            return True
        return self._find(record, None, self._roads(robot, forbidden), None, effort)

    def _note_unreachable(self, record: RobotRecord, *, is_unreachable: bool) -> None:
        barred = self._state.forbidden(record.id) if is_unreachable else ()
        note_unreachable(self._state, record, is_unreachable=is_unreachable, barred=barred)

    def _find(
        self, record: RobotRecord, goal: int | None, roads: Roads, field: Sequence[int] | None, effort: int
    ) -> bool:
        """Enter a path to a goal, or out of the way, into the ledger; return whether there is one."""
        ledger, robot = self._state.ledger, record.id
        self._cut(robot, roads)
        found = find_path(roads, ledger, robot, goal, field, effort)
        if found is None:
            return False
        keep, path = found
        ledger.truncate(robot, keep=len(ledger.granted(robot)) + keep)
        ledger.insert(robot, path)
        record.rest = ledger.route(robot)[-1] if goal is None else None
        return True

    def _cut(self, robot: str, roads: Roads) -> None:
        """End a robot's route before the first cell that it may not enter."""
        ledger = self._state.ledger
        route, granted = ledger.route(robot), len(ledger.granted(robot))
        for index in range(granted, len(route)):
            if route[index] in roads.shut or (route[index - 1], route[index]) in roads.closed:
                ledger.truncate(robot, keep=index)
                return

    def replan_alone(self, record: RobotRecord) -> None:
        """Give a robot its shortest path, without regard to the others that drive."""
        state, goal = self._state, record.goal
        start = state.ledger.end_of_grant(record.id)
        assert start is not None
        forbidden = state.forbidden(record.id)
        roads = self._roads(record.id, forbidden)
        field = [FAR] * len(roads.neighbours)
        if goal is not None and goal not in roads.shut:
            field = costs_to(goal, roads)
        is_unreachable = goal is not None and field[start] >= FAR
        self._note_unreachable(record, is_unreachable=is_unreachable)
        if goal is None or is_unreachable or goal == start:
            return
        path, step, cell = [], state.ledger.start_step(record.id), start
        while cell != goal:
            ways = [
                way
                for way in roads.neighbours[cell]
                if way not in roads.shut and (cell, way) not in roads.closed
            ]
            _, cell = min((field[way] + roads.cost(cell, way), way) for way in ways)
            step += 1.0
            path.append((cell, step))
        state.ledger.insert(record.id, path)

    def _can_reach(self, start: int, goal: int, robot: str, forbidden: frozenset[int]) -> bool:
        if self._state.is_shut(goal) or goal in forbidden:
            return False
        return start == goal or self._field(goal, robot, forbidden)[start] < FAR

    def _roads(self, robot: str, forbidden: frozenset[int]) -> Roads:
        """Return where a robot may drive."""
        state = self._state
        shut = set(state.blocked) | state.pending | forbidden
        for other in state.robots.values():
            if other.phase is not Phase.ACTIVE:
                shut |= state.ledger.claims(other.id)
        return Roads(
            state.grid.neighbours,
            shut,
            state.closed(robot),
            state.zones.costs_of(robot),
            frozenset(state.index.goals),
            state.move_costs(),
            self._turns(robot),
        )

    def _turns(self, robot: str) -> Turns | None:
        if self._turn_steps is None:
            return None
        return Turns(heading_at_start(self._state, robot), self._state.grid.columns, self._turn_steps)

    def _field(self, goal: int, robot: str, forbidden: frozenset[int]) -> array[int]:
        """Return the number of moves to a goal from each cell, without regard to robots."""
        state = self._state
        most = min(_FIELDS, _FIELD_BYTES // (_CELL_BYTES * len(state.grid)))
        if self._version != state.map_version or len(self._fields) >= max(most, 1):
            self._fields.clear()
            self._version = state.map_version
        key = goal, forbidden, state.zones.closed_for(robot, state.grid)
        found = self._fields.get(key)
        if found is None:
            shut = state.blocked | state.pending | forbidden
            moves = moves_to(goal, state.grid.neighbours, shut, state.closed(robot))
            found = self._fields[key] = array("i", moves)
        return found
