"""The fleet planner: events in, instructions out.

The planner owns the cells. A robot only ever drives within cells that it was granted, so two robots cannot
meet. Cells are taken back only from a robot that has stopped: it is told to (``HOLDING``), its move client
acknowledges, its poses stand still, and then it keeps the cells that it overlaps. While a robot is being
stopped no robot is granted anything new; then one plan is made for all from the cells they are committed to.

Plans take long and are computed elsewhere: :class:`MakePlan` goes out, :class:`PlanMade` comes in, and
nothing new is granted meanwhile. If the fleet has changed by then, the part of the plan that is still
possible is used, so that robots make progress however often things change, and the next plan is requested.

The cost of an event depends on what it changes: records that depend on other robots are found by indexes.
"""

from __future__ import annotations

from math import inf, isfinite, isnan
from typing import TYPE_CHECKING, Any

from rce_fleet.coordination.blocking import CellBlocking
from rce_fleet.coordination.deadlines import ROUNDING, Deadlines
from rce_fleet.coordination.dispatcher import Dispatcher
from rce_fleet.coordination.events import (
    CellBlocked,
    CellFreed,
    Event,
    GoalSet,
    Instruction,
    ObstacleGone,
    ObstacleSeen,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    RobotHeard,
    RobotRemoved,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.fleet_state import FleetState
from rce_fleet.coordination.refusals import refuse_goal
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.coordination.changes import FleetChanges
    from rce_fleet.coordination.snapshot import FleetSnapshot
    from rce_fleet.planning.grid import GridMap

NO_POSE = "it has sent no pose yet: its localization does not run, or has no map or scans"


class FleetPlanner:
    """Plans for a fleet on a grid, and grants cells to its robots.

    Args:
        grid: The map; its blocked cells are walls and never freed.
        settings: Sizes and times.
        first_revision: Number of the first list of cells. If move clients report higher numbers, from
            before a restart of the planner, the next lists continue from those.
    """

    def __init__(
        self, grid: GridMap, settings: FleetSettings | None = None, *, first_revision: int = 0
    ) -> None:
        self.state = FleetState(grid)
        self.settings = settings or FleetSettings()
        self._first_revision = first_revision
        self._deaf_until: dict[str, float] = {}
        self._deadlines = Deadlines()
        self._dispatcher = Dispatcher(self.state, self.settings)
        self._blocking = CellBlocking(self.state, self._dispatcher)
        self._now = 0.0
        self._handlers: dict[type, Callable[[Any], Reply | None]] = {
            PoseSeen: self._take_pose,
            RobotHeard: self._take_sign,
            ReportSeen: self._take_report,
            ObstacleSeen: self._blocking.take_obstacle,
            ObstacleGone: self._blocking.take_gone,
            GoalSet: self._set_goal,
            CellBlocked: self._blocking.block_cell,
            CellFreed: self._blocking.free_cell,
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
            if self._deadlines[record.id] > self._due(record) + ROUNDING:
                raise InvariantError(f"{record.id} is looked at too late, at {self._deadlines[record.id]}")

    # What robots say

    def _take_pose(self, event: PoseSeen) -> None:
        if not (isfinite(event.x) and isfinite(event.y) and isfinite(event.yaw)) or self._gone(event.robot):
            return
        record = self._record(event.robot)
        record.see(event.x, event.y, event.yaw, self._now, self.settings)
        if self.state.sensed:
            here = self.state.grid.cell_at(event.x, event.y)
            if here is not None:
                self._blocking.take_robot(here)
        if record.reason == NO_POSE:
            record.reason = "new"
            self.state.touch(record)
        self._look_soon_if_silent(record)
        if record.phase is Phase.ACTIVE:
            self._follow(record)
            return
        if not self.state.ledger.length(record.id):
            self._watch_newcomer(record)
        if record.phase is Phase.HOLDING:
            self._dispatcher.to_settle.add(record.id)

    def _take_sign(self, event: RobotHeard) -> None:
        if self._gone(event.robot):
            return
        record = self._record(event.robot)
        record.hear(self._now - max(event.age, 0.0))
        self._look_soon_if_silent(record)
        if record.phase is Phase.HOLDING:
            self._dispatcher.to_settle.add(record.id)

    def _take_report(self, event: ReportSeen) -> None:
        if self._gone(event.robot):
            return
        record = self._record(event.robot)
        known, report = record.report, event.report
        record.take(report, self._now)
        self._look_soon_if_silent(record)
        if record.phase is Phase.HOLDING:
            self._dispatcher.to_settle.add(record.id)
        if report.revision > record.revision:
            record.revision = report.revision
            self._dispatcher.hold(record, "its move client knows an earlier planner")
        elif known is not None and report.revision < known.revision:
            if record.phase is Phase.ACTIVE:
                self._dispatcher.hold(record, "its move client was restarted")
            self._deadlines.hasten(record.id, self._now)

    def _look_soon_if_silent(self, record: RobotRecord) -> None:
        if record.phase is Phase.SILENT:
            self._deadlines.hasten(record.id, self._now)

    def _follow(self, record: RobotRecord) -> None:
        """Update the progress of an active robot."""
        if not self._dispatcher.arrive(record):
            here = self.state.grid.cell_at(record.x, record.y)
            if here not in self.state.ledger.claims(record.id):
                record.rest = None  # It was carried away: it stays where it was put.
                self._dispatcher.hold(record, "it left its path")
                self._make_room(record)

    def _watch_newcomer(self, record: RobotRecord) -> None:
        """Stop robots whose cells a robot without a cell overlaps."""
        before = self.state.ledger.claims(record.id)
        self.state.ledger.overlap(record.id, self._dispatcher.touched(record))
        if self.state.ledger.claims(record.id) != before:
            self._dispatcher.outdated = True
        self._make_room(record)

    def _make_room(self, record: RobotRecord) -> None:
        """Stop robots that were granted cells which another robot overlaps."""
        for cell in self._dispatcher.touched(record):
            owner = self.state.ledger.owner(cell)
            other = self.state.robots.get(owner) if owner is not None else None
            if other is None or other is record or other.phase is not Phase.ACTIVE:
                continue
            if cell in self.state.ledger.granted(other.id)[1:]:
                self._dispatcher.hold(other, f"{record.id} is in its way")

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
            record.goal, record.rest = event.cell, None
            self.state.touch(record)
            self._dispatcher.outdated = True
            if record.phase is Phase.ACTIVE and len(self.state.ledger.granted(record.id)) > 1:
                self._dispatcher.hold(record, "it has a new goal")
        if event.cell is None:
            return Reply(True, f"{record.id} has no goal")
        return Reply(True, f"{record.id} goes to cell {event.cell}")

    def _remove_robot(self, event: RobotRemoved) -> Reply:
        if event.robot not in self.state.robots:
            return Reply(False, f"robot {event.robot} is unknown")
        # Messages that are still on the way must not add it again.
        self._deaf_until[event.robot] = self._now + self.settings.silence_timeout
        self._deadlines.forget(event.robot)
        self.state.remove(event.robot)
        self._dispatcher.outdated = True
        return Reply(True, f"{event.robot} was removed")

    # Time

    def _take_tick(self, _event: Tick) -> None:
        for robot in self._deadlines.take_due(self._now):
            record = self.state.robots[robot]
            self._check_timeouts(record)
            self._deadlines.set(robot, self._due(record))

    def _check_timeouts(self, record: RobotRecord) -> None:
        """Handle timeouts of one robot."""
        heard = record.heard(self._now, self.settings)
        if record.phase is Phase.SILENT:
            if heard:
                self.state.change(record, Cause.HEARD, "it sends messages again")
                self._dispatcher.hold(record, "it sends messages again")
        elif not heard:
            self._lose(record)
        elif isnan(record.x) and record.reason != NO_POSE:
            record.reason = NO_POSE
            self.state.touch(record)
        elif record.phase is Phase.ACTIVE and self._stalled(record):
            self._dispatcher.hold(record, "it did not move")
        elif self._now - record.sent_at >= self.settings.repeat_after:
            self._repeat(record)

    def _due(self, record: RobotRecord) -> float:
        """Return when to check a robot next, if no message from it or to it comes before.

        A message that is sent later is also repeated later, so a check every ``repeat_after`` seconds is
        enough.
        """
        if record.phase is Phase.SILENT:
            return inf
        sent = record.sent_at if self._is_unconfirmed(record) else self._now
        times = [
            max(sent, self._now - self.settings.repeat_after) + self.settings.repeat_after,
            min(record.alive_at, record.reported_at) + self.settings.silence_timeout,
        ]
        if self._is_busy(record):
            times.append(max(record.still_since(), record.sent_at) + self.settings.stall_timeout)
        return min(times)

    def _lose(self, record: RobotRecord) -> None:
        robot_first = record.alive_at < record.reported_at
        reason = (
            "the robot sends neither poses nor states of its goals"
            if robot_first
            else "its move client sends no reports"
        )
        self.state.change(record, Cause.LOST, reason)
        self.state.ledger.truncate(record.id)
        self._dispatcher.outdated = True

    def _is_busy(self, record: RobotRecord) -> bool:
        """Return whether a robot has cells to drive to."""
        granted = self.state.ledger.granted(record.id)
        return record.phase is Phase.ACTIVE and (len(granted) > 1 or not record.centred)

    def _stalled(self, record: RobotRecord) -> bool:
        """Return whether a robot has had cells to drive to for long and has not moved."""
        since = max(record.still_since(), record.sent_at)
        return self._is_busy(record) and self._now - since > self.settings.stall_timeout

    def _is_unconfirmed(self, record: RobotRecord) -> bool:
        """Return whether a move client has not acknowledged the last list."""
        return record.report is None or record.report.revision != record.revision

    def _repeat(self, record: RobotRecord) -> None:
        """Send unacknowledged messages again."""
        if not self._is_unconfirmed(record):
            return
        if record.phase is Phase.HOLDING:
            record.sent_at = self._now
            self._dispatcher.out += [SendCancel(record.id), SendCells(record.id, record.revision, ())]
        elif record.phase is Phase.ACTIVE:
            self._dispatcher.send(record, tuple(self.state.ledger.granted(record.id)))

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
