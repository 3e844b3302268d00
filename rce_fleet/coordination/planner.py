"""The fleet planner: events in, instructions out.

The planner owns the cells. A robot only ever drives within cells that it was granted, so two robots cannot
meet. Cells are taken back only from a robot that has stopped: it is told to (``HOLDING``), its move client
acknowledges, its poses stand still, and then it keeps the cells that it overlaps. While a robot is being
stopped no robot is granted anything new; then one plan is made for all from the cells they are committed to.

Plans take long and are computed elsewhere: :class:`MakePlan` goes out, :class:`PlanMade` comes in, and
nothing new is granted meanwhile. If the fleet has changed by then, the part of the plan that is still
possible is used, so that robots make progress however often things change, and the robots whose part is not
possible get other paths.

The cost of an event depends on what it changes: records that depend on other robots are found by indexes.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

from rce_fleet.coordination.blocking import CellBlocking
from rce_fleet.coordination.deadlines import ROUNDING, Deadlines
from rce_fleet.coordination.dispatcher import Dispatcher
from rce_fleet.coordination.events import (
    CellBlocked,
    CellFreed,
    CostsSet,
    Event,
    GoalSet,
    Instruction,
    ModeSet,
    ObstacleGone,
    ObstacleSeen,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    RobotHeard,
    RobotRemoved,
    RobotsExpected,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.fleet_state import FleetState
from rce_fleet.coordination.localization import is_lost
from rce_fleet.coordination.mode_control import ModeControl
from rce_fleet.coordination.refusals import refuse_goal
from rce_fleet.coordination.robot import Phase, RobotRecord
from rce_fleet.coordination.robot_watch import NO_POSE, RobotWatch
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.zones import ZoneBook
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.coordination.changes import FleetChanges
    from rce_fleet.coordination.snapshot import FleetSnapshot
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.lanes import LaneGraph

_AT_ONCE = frozenset({CellBlocked, ModeSet, ObstacleSeen, ZonesSet})
"""Events after which the robots concerned get new paths before the next tick: their ways are cut."""


EARLIER_LIST = "its move client knows an earlier planner"
FOREIGN_LIST = "its move client took a list of another planner or program: end that one"
"""Why a robot is stopped whose move client had taken a list of this planner before."""


class FleetPlanner:
    """Plans for a fleet on a grid, and grants cells to its robots.

    Args:
        grid: The map; its blocked cells are walls and never freed.
        settings: Sizes and times.
        first_revision: Number of the first list of cells. If move clients report higher numbers, from
            before a restart of the planner, the next lists continue from those.
        lanes: Lanes that robots keep to; cells of the grid that are on none have to be walls.
    """

    def __init__(
        self,
        grid: GridMap,
        settings: FleetSettings | None = None,
        *,
        first_revision: int = 0,
        lanes: LaneGraph | None = None,
    ) -> None:
        self.state = FleetState(grid, zones=ZoneBook(lanes))
        self.settings = settings or FleetSettings()
        self._first_revision = first_revision
        self._deaf_until: dict[str, float] = {}
        self._deadlines = Deadlines()
        self._dispatcher = Dispatcher(self.state, self.settings)
        self._blocking = CellBlocking(self.state, self._dispatcher)
        self._modes = ModeControl(self.state, self._dispatcher)
        self._watch = RobotWatch(self.state, self.settings, self._dispatcher)
        self._now = 0.0
        self._handlers: dict[type, Callable[[Any], Reply | None]] = {
            PoseSeen: self._take_pose,
            RobotHeard: self._take_sign,
            ReportSeen: self._take_report,
            RobotsExpected: self._expect,
            ObstacleSeen: self._blocking.take_obstacle,
            ObstacleGone: self._blocking.take_gone,
            GoalSet: self._set_goal,
            CellBlocked: self._blocking.block_cell,
            CellFreed: self._blocking.free_cell,
            ZonesSet: self._blocking.set_zones,
            CostsSet: self._blocking.set_costs,
            ModeSet: self._modes.set_mode,
            RobotRemoved: self._remove_robot,
            PlanMade: lambda event: self._dispatcher.take_plan(event.result),
            Tick: self._take_tick,
        }

    # Publishing

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Handle an event at time ``now`` (seconds, monotonic); return the instructions."""
        dispatcher = self._dispatcher
        self._now = dispatcher.now = now
        dispatcher.out = []
        dispatcher.is_tick, dispatcher.at_once = False, type(event) in _AT_ONCE
        reply = self._handlers[type(event)](event)
        if reply is not None:
            dispatcher.out.append(reply)
        dispatcher.advance()
        return dispatcher.out

    def snapshot(self) -> FleetSnapshot:
        """Return the state for publishing."""
        return self.state.snapshot()

    def take_changes(self) -> FleetChanges | None:
        """Return what changed of the snapshot since the last call, poses not counted; None if nothing did."""
        return self.state.take_changes()

    def is_taking_over(self) -> bool:
        """Return whether the rest of a plan is taken over with the next events."""
        return self._dispatcher.is_taking_over()

    @property
    def expected(self) -> list[str]:
        """Robots that exist and have not been heard yet; no cells are granted until they are, for a while."""
        return sorted(self._dispatcher.expected)

    @property
    def sequence(self) -> int:
        """Number of the last change that :meth:`take_changes` returned; the snapshot holds it."""
        return self.state.log.sequence

    def validate(self) -> None:
        """Check that the records are consistent, and that everything possible was done.

        Raises:
            InvariantError: Records contradict each other, or something was not done.
        """
        self.state.validate()
        self._dispatcher.validate()
        for record in self.state.robots.values():
            if self._deadlines[record.id] > self._watch.due(record) + ROUNDING:
                raise InvariantError(f"{record.id} is looked at too late, at {self._deadlines[record.id]}")

    # What robots say

    def _take_pose(self, event: PoseSeen) -> None:
        if not event.is_possible or self._gone(event.robot):
            return
        record = self._record(event.robot)
        record.see(event.x, event.y, event.yaw, self._now, self.settings)
        self._note_doubt(record)
        self._note_lost(record, event)
        if not record.lost:
            self._clear_cell(event)
        elif record.phase is Phase.STANDING:
            return
        if record.reason == NO_POSE:
            record.reason = "new"
            self.state.touch(record)
        self._look_soon_if_silent(record)
        if record.phase in (Phase.ACTIVE, Phase.STANDING):
            if record.jumped_at == self._now:
                self._distrust(record)
            else:
                self._follow(record)
        if record.phase is not Phase.ACTIVE or record.id in self.state.index.displaced.cells:
            self._dispatcher.watch(record)
        if record.phase is Phase.HOLDING:
            self._dispatcher.to_settle.add(record.id)

    def _clear_cell(self, event: PoseSeen) -> None:
        """Free the cell that a robot is in, if sensors found it blocked."""
        here = self.state.grid.cell_at(event.x, event.y) if self.state.sensed else None
        if here is not None:
            self._blocking.take_robot(here)

    def _take_sign(self, event: RobotHeard) -> None:
        if not isfinite(event.age) or self._gone(event.robot):
            return
        record = self._record(event.robot)
        record.hear(self._now - max(event.age, 0.0), self.settings)
        self._look_soon_if_silent(record)
        if record.phase is Phase.HOLDING:
            self._dispatcher.to_settle.add(record.id)

    def _take_report(self, event: ReportSeen) -> None:
        if self._gone(event.robot):
            return
        record = self._record(event.robot)
        known, report = record.report, event.report
        if record.pose_only:
            self.state.touch(record)
        record.take(report, self._now)
        self._look_soon_if_silent(record)
        if record.phase is Phase.HOLDING:
            self._dispatcher.to_settle.add(record.id)
            if not self.state.ledger.length(record.id):
                self._dispatcher.watch(record)
        if report.revision > record.revision:
            record.revision = report.revision
            self._dispatcher.hold(record, FOREIGN_LIST if record.took_list else EARLIER_LIST)
        elif known is not None and report.revision < known.revision:
            if record.phase is Phase.ACTIVE:
                self._dispatcher.hold(record, "its move client was restarted")
            self._deadlines.hasten(record.id, self._now)
        if record.phase is Phase.ACTIVE and known is not None and known.target != report.target:
            self._dispatcher.arrive(record)

    def _expect(self, event: RobotsExpected) -> None:
        """Wait for robots before any cell is granted, and claim the cells that they may be in."""
        for robot in sorted(event.robots):
            if robot in self.state.robots or self._gone(robot):
                continue
            self._dispatcher.expected[robot] = self._now + self.settings.expect_timeout
            cells = [cell for cell in event.robots[robot] if cell in self.state.grid]
            if not cells:
                continue
            record = self._record(robot)
            record.earlier = frozenset(cells)
            self.state.ledger.overlap(robot, cells)
            if not record.earlier <= self.state.ledger.claims(robot):
                # Others, on whose paths they are, claim some of them until they are heard.
                self.state.index.displaced.put(robot, cells)
            self._dispatcher.avoid(record)

    def _look_soon_if_silent(self, record: RobotRecord) -> None:
        if record.phase is Phase.SILENT:
            self._deadlines.hasten(record.id, self._now)

    def _follow(self, record: RobotRecord) -> None:
        """Update the progress of an active robot."""
        if self._dispatcher.is_pushed(record):
            self._dispatcher.hold(record, "it was pushed along its path")
        elif not self._dispatcher.arrive(record) and self._dispatcher.has_left(record):
            record.rest = None  # It was carried away: it stays where it was put.
            self._dispatcher.hold(record, "it left its path")

    def _note_doubt(self, record: RobotRecord) -> None:
        """Note where a robot may be after its newest pose: also where it was, if the pose jumped."""
        if record.jumped_at == self._now:
            record.doubted |= self.state.ledger.overlapped(record.id)
            self._blocking.free_latest_of(record.id)
        elif record.doubted and record.is_steady(self.settings) and not self.state.ledger.length(record.id):
            record.doubted = frozenset()
        has_heard = record.pose_only and self._now - record.held_at >= self.settings.pose_only_settle
        if has_heard and self.state.mode_of(record).is_followed:
            record.earlier = frozenset()  # From now on its cells follow its poses.

    def _note_lost(self, record: RobotRecord, pose: PoseSeen) -> None:
        """Note whether a robot knows where it is, after its newest pose."""
        why = is_lost(record, pose, self.settings)
        if why != record.lost:
            self._modes.set_lost(record, why)
            if why:
                self._blocking.free_latest_of(record.id)

    def _distrust(self, record: RobotRecord) -> None:
        """Stop a robot whose pose jumped; it keeps its cells until its poses have agreed for a while."""
        record.rest = None
        self._dispatcher.hold(record, "its pose jumped farther than it can drive: localize it")

    # Requests

    def _set_goal(self, event: GoalSet) -> Reply:
        record = self.state.robots.get(event.robot)
        if record is None:
            return Reply(False, f"robot {event.robot} is unknown")
        if event.cell is not None:
            refusal = refuse_goal(self.state, record, event.cell)
            if refusal:
                return Reply(False, refusal)
        if record.goal != event.cell:
            record.goal, record.rest, record.goal_at = event.cell, None, self._now
            record.no_path = ""
            self.state.touch(record)
            self._dispatcher.require([record.id])
            self._drop_path(record)
        if event.cell is None:
            return Reply(True, f"{record.id} has no goal")
        return Reply(True, f"{record.id} goes to cell {event.cell}")

    def _drop_path(self, record: RobotRecord) -> None:
        """Take a robot's path to its goal before; its new path begins where its granted cells end.

        Without a goal it stops at once, unless it is driven by its poses: none might show that it stopped.
        """
        if record.phase is not Phase.ACTIVE:
            return
        if record.goal is None and not record.pose_only and len(self.state.ledger.granted(record.id)) > 1:
            self._dispatcher.hold(record, "its goal was removed")
        else:
            self.state.ledger.truncate(record.id)

    def _remove_robot(self, event: RobotRemoved) -> Reply:
        if event.robot not in self.state.robots:
            return Reply(False, f"robot {event.robot} is unknown")
        # Messages that are still on the way must not add it again.
        self._deaf_until[event.robot] = self._now + self.settings.silence_timeout
        self._deadlines.forget(event.robot)
        self._dispatcher.forget(event.robot)
        self.state.remove(event.robot)
        self._dispatcher.require(other.id for other in self.state.robots.values() if other.unreachable)
        return Reply(True, f"{event.robot} was removed")

    # Time

    def _take_tick(self, _event: Tick) -> None:
        self._dispatcher.is_tick = True
        self._blocking.end_expired(self._now)
        for robot in self._deadlines.take_due(self._now):
            record = self.state.robots[robot]
            self._watch.check(record)
            self._deadlines.set(robot, self._watch.due(record))

    # Small things

    def _gone(self, robot: str) -> bool:
        """Return whether a robot was removed recently."""
        return self._now < self._deaf_until.get(robot, self._now)

    def _record(self, robot: str) -> RobotRecord:
        record = self.state.robots.get(robot)
        if record is None:
            record = self.state.robots[robot] = RobotRecord(
                robot, self._first_revision, alive_at=self._now, reported_at=self._now
            )
            self._deadlines.set(robot, self._now + self.settings.repeat_after)
            self._dispatcher.hold(record, "new")
        return record
