"""The fleet planner: events in, instructions out.

The planner owns the cells. A robot only ever drives within cells that it was granted, so two robots cannot
meet. Cells are taken back only from a robot that has stopped: it is told to (``HOLDING``), its move client
acknowledges, its poses stand still, and then it keeps the cells that it overlaps. While somebody is being
stopped nobody is granted anything new; then one plan is made for all from the cells they are committed to.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    Event,
    GoalSet,
    Instruction,
    ObstacleSeen,
    PoseSeen,
    Reply,
    ReportSeen,
    RobotRemoved,
    SendCancel,
    SendCells,
    StateChanged,
    Tick,
)
from rce_fleet.coordination.fleet_state import FleetState
from rce_fleet.coordination.progress import arrived_index, standing_cell
from rce_fleet.coordination.replanning import plan_together
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.coordination.settings import FleetSettings

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.coordination.snapshot import FleetSnapshot
    from rce_fleet.planning.grid import GridMap


class FleetPlanner:
    """Steers a fleet over a grid.

    Args:
        grid: The map; its blocked cells are walls and never freed.
        settings: Sizes and times.
        first_revision: Lists of cells are numbered from here. Move clients may remember an earlier life
            of the planner; whatever they report moves the numbers on.
    """

    def __init__(
        self, grid: GridMap, settings: FleetSettings | None = None, *, first_revision: int = 0
    ) -> None:
        self.books = FleetState(grid)
        self.settings = settings or FleetSettings()
        self._first_revision = first_revision
        self._deaf_until: dict[str, float] = {}
        self._outdated = False
        self._partial = False
        self._attempt = 0
        self._changed = False
        self._now = 0.0
        self._out: list[Instruction] = []
        self._handlers: dict[type, Callable[[Any], Reply | None]] = {
            PoseSeen: self._take_pose,
            ReportSeen: self._take_report,
            ObstacleSeen: self._take_obstacle,
            GoalSet: self._set_goal,
            CellBlocked: self._block_cell,
            CellFreed: self._free_cell,
            RobotRemoved: self._remove_robot,
            Tick: self._take_tick,
        }

    # -- the outside --------------------------------------------------------------------------------

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Take an event that happened at ``now`` (seconds, never going back) and say what to do."""
        self._now = now
        self._out = []
        reply = self._handlers[type(event)](event)
        if reply is not None:
            self._out.append(reply)
        self._advance()
        if self._changed:
            self._changed = False
            self._out.append(StateChanged())
        return self._out

    def snapshot(self) -> FleetSnapshot:
        """The state as the outside sees it."""
        return self.books.snapshot()

    def validate(self) -> None:
        """Check the books.

        Raises:
            InvariantError: They contradict each other.
        """
        self.books.validate()

    # -- what robots say ------------------------------------------------------------------------------

    def _take_pose(self, event: PoseSeen) -> None:
        if not (isfinite(event.x) and isfinite(event.y) and isfinite(event.yaw)) or self._gone(event.robot):
            return
        record = self._record(event.robot)
        record.see(event.x, event.y, event.yaw, self._now, self.settings)
        if record.phase is Phase.ACTIVE:
            self._follow(record)
        elif not self.books.ledger.route(record.id):
            self._watch_newcomer(record)

    def _take_report(self, event: ReportSeen) -> None:
        if self._gone(event.robot):
            return
        record = self._record(event.robot)
        known, report = record.report, event.report
        record.take(report, self._now)
        if report.revision > record.revision:
            record.revision = report.revision
            self._hold(record, "its move client knows an earlier planner")
        elif known is not None and report.revision < known.revision and record.phase is Phase.ACTIVE:
            self._hold(record, "its move client was started again")

    def _take_obstacle(self, event: ObstacleSeen) -> None:
        for cell in event.cells:
            owner = self.books.ledger.owner(cell) if cell in self.books.grid else None
            standing = cell in self.books.ledger.route(event.robot)[:1]
            # Cells of other robots are theirs: what was seen there was a robot.
            if cell in self.books.grid and owner in (None, event.robot) and not standing:
                self._shut(cell)

    def _follow(self, record: RobotRecord) -> None:
        """See how far an active robot has come."""
        if not self._arrive(record):
            here = self.books.grid.cell_at(record.x, record.y)
            if here not in self.books.ledger.claims(record.id):
                record.rest = None  # Somebody carried it away: it rests where it was put.
                self._hold(record, "it left its path")
                self._make_room(record)

    def _arrive(self, record: RobotRecord) -> bool:
        """Leave behind the cells that a robot has left; tell whether it is on its path."""
        granted = self.books.ledger.granted(record.id)
        index = arrived_index(self.books.grid, granted, record.x, record.y, self.settings)
        if index is None:
            return False
        if index > 0 or not record.centred:
            record.centred = True
            self.books.ledger.arrive(record.id, index)
            self._changed = True
        return True

    def _watch_newcomer(self, record: RobotRecord) -> None:
        """Keep the others away from a robot that has no cell yet."""
        before = self.books.ledger.claims(record.id)
        self.books.ledger.overlap(record.id, self._touched(record))
        if self.books.ledger.claims(record.id) != before:
            self._outdated = self._changed = True
        self._make_room(record)

    def _make_room(self, record: RobotRecord) -> None:
        """Stop those that were granted cells which a robot overlaps without owning them."""
        for cell in self._touched(record):
            owner = self.books.ledger.owner(cell)
            other = self.books.robots.get(owner) if owner is not None else None
            if other is None or other is record or other.phase is not Phase.ACTIVE:
                continue
            if cell in self.books.ledger.granted(other.id)[1:]:
                self._hold(other, f"{record.id} is in its way")

    # -- what people want -----------------------------------------------------------------------------

    def _set_goal(self, event: GoalSet) -> Reply:
        record = self.books.robots.get(event.robot)
        if record is None:
            return Reply(False, f"there is no robot {event.robot}")
        if event.cell is not None:
            refusal = self._refuse_goal(record, event.cell)
            if refusal:
                return Reply(False, refusal)
        if record.goal != event.cell:
            record.goal, record.rest = event.cell, None
            self._outdated = self._changed = True
            if record.phase is Phase.ACTIVE and len(self.books.ledger.granted(record.id)) > 1:
                self._hold(record, "it has a new goal")
        if event.cell is None:
            return Reply(True, f"{record.id} has no goal")
        return Reply(True, f"{record.id} goes to cell {event.cell}")

    def _refuse_goal(self, record: RobotRecord, cell: int) -> str:
        if cell not in self.books.grid:
            return f"cell {cell} is not on the map of {len(self.books.grid)} cells"
        if cell in self.books.shut:
            return f"cell {cell} is blocked"
        for other in self.books.robots.values():
            if other is not record and other.goal == cell:
                return f"cell {cell} is the goal of {other.id}"
        return ""

    def _block_cell(self, event: CellBlocked) -> Reply:
        cell = event.cell
        refusal = self._refuse_cell(cell)
        if refusal:
            return Reply(False, refusal)
        self._shut(cell)
        owner = self.books.ledger.owner(cell)
        if owner is None:
            return Reply(True, f"cell {cell} is blocked")
        return Reply(True, f"cell {cell} will be blocked when {owner} has left it")

    def _refuse_cell(self, cell: int) -> str:
        if cell not in self.books.grid:
            return f"cell {cell} is not on the map of {len(self.books.grid)} cells"
        return f"cell {cell} is a wall" if cell in self.books.grid.blocked else ""

    def _free_cell(self, event: CellFreed) -> Reply:
        cell = event.cell
        refusal = self._refuse_cell(cell)
        if refusal:
            return Reply(False, refusal)
        if cell not in self.books.blocked | self.books.pending:
            return Reply(True, f"cell {cell} is not blocked")
        if cell in self.books.blocked:
            self.books.blocked.discard(cell)
            self._out.append(BlockedChanged(tuple(sorted(self.books.blocked))))
        self.books.pending.discard(cell)
        self._outdated = self._changed = True
        return Reply(True, f"cell {cell} is free")

    def _remove_robot(self, event: RobotRemoved) -> Reply:
        if self.books.robots.pop(event.robot, None) is None:
            return Reply(False, f"there is no robot {event.robot}")
        # Messages that are under way must not bring it back.
        self._deaf_until[event.robot] = self._now + self.settings.silence_timeout
        self.books.ledger.remove(event.robot)
        self._outdated = self._changed = True
        return Reply(True, f"{event.robot} is gone")

    def _shut(self, cell: int) -> None:
        """Block a cell as soon as nobody claims it; stop those whose paths lead through it."""
        if cell in self.books.shut:
            return
        self.books.pending.add(cell)
        self._outdated = self._changed = True
        for record in self.books.robots.values():
            if record.phase is Phase.ACTIVE and cell in self.books.ledger.route(record.id)[1:]:
                record.replans += 1
                self._hold(record, f"cell {cell} on its path is blocked")

    # -- time -----------------------------------------------------------------------------------------

    def _take_tick(self, _event: Tick) -> None:
        for record in self.books.robots.values():
            heard = record.heard(self._now, self.settings)
            if record.phase is Phase.SILENT:
                if heard:
                    record.change(Cause.HEARD)
                    self._hold(record, "it is back")
            elif not heard:
                self._lose(record)
            elif record.phase is Phase.ACTIVE and self._stalled(record):
                self._hold(record, "it did not move")
            elif self._now - record.sent_at >= self.settings.repeat_after:
                self._repeat(record)

    def _lose(self, record: RobotRecord) -> None:
        record.change(Cause.LOST)
        robot_first = record.posed_at < record.reported_at
        record.reason = "the robot is not heard" if robot_first else "its move client is not heard"
        if self.books.ledger.route(record.id):
            self.books.ledger.truncate(record.id)
        self._outdated = self._changed = True

    def _stalled(self, record: RobotRecord) -> bool:
        """Whether a robot has had cells to drive to for long, and has not moved."""
        busy = len(self.books.ledger.granted(record.id)) > 1 or not record.centred
        since = max(record.still_since(), record.sent_at)
        return busy and self._now - since > self.settings.stall_timeout

    def _repeat(self, record: RobotRecord) -> None:
        """Say again what did not get through."""
        if record.report is None or record.report.revision != record.revision:
            if record.phase is Phase.HOLDING:
                record.sent_at = self._now
                self._out += [SendCancel(record.id), SendCells(record.id, record.revision, ())]
            elif record.phase is Phase.ACTIVE:
                self._send(record, tuple(self.books.ledger.granted(record.id)))

    # -- going on -------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Do everything that has become possible."""
        for record in self.books.robots.values():
            if record.phase is Phase.HOLDING and record.stands(self.settings):
                self._settle(record)
        self._block_left_cells()
        if not self._outdated and self._partial and self._finished():
            self._outdated = True
        if self._outdated and not self._awaited():
            self._plan()
        if not self._outdated:
            for record in self.books.robots.values():
                if record.phase is Phase.ACTIVE and self.books.ledger.grant(record.id, self.settings.ahead):
                    self._send(record, tuple(self.books.ledger.granted(record.id)))

    def _hold(self, record: RobotRecord, reason: str) -> None:
        """Tell a robot to stop, to take its cells back once it has."""
        if record.phase is Phase.SILENT:
            return
        record.change(Cause.HELD)
        record.reason, record.held_at = reason, self._now
        if self.books.ledger.route(record.id):
            self.books.ledger.truncate(record.id)
        self._outdated = self._changed = True
        self._send(record, ())

    def _settle(self, record: RobotRecord) -> None:
        """Give a robot that stands still the cell that it stands in."""
        books = self.books
        touched = self._touched(record)
        own = {cell for cell in touched if books.ledger.owner(cell) in (None, record.id)}
        cell = standing_cell(books.grid, own, record.x, record.y, books.shut)
        obstacle = self._hindrance(record, touched, own, cell)
        if cell is None or obstacle:
            self._changed |= record.reason != obstacle
            record.reason = obstacle
            return
        record.change(Cause.SETTLED)
        record.reason = ""
        record.centred = False
        # Nobody claims what is blocked already: the robot only touches the margin around the box.
        books.ledger.place(record.id, cell, own - books.blocked - books.grid.blocked)
        self._outdated = self._changed = True
        self._send(record, (cell,))
        self._arrive(record)

    def _hindrance(self, record: RobotRecord, touched: set[int], own: set[int], cell: int | None) -> str:
        """Why a robot cannot take its place in ``cell``; empty if it can."""
        if not touched:
            return "it is outside of the map"
        if cell is None or (own != touched and not self.books.ledger.route(record.id)):
            return "it stands in somebody else's cell"
        if cell in self.books.blocked or cell in self.books.grid.blocked:
            return "it stands in a blocked cell"
        return ""

    def _block_left_cells(self) -> None:
        left = {cell for cell in self.books.pending if self.books.ledger.owner(cell) is None}
        if left:
            self.books.pending -= left
            self.books.blocked |= left
            self._changed = True
            self._out.append(BlockedChanged(tuple(sorted(self.books.blocked))))

    def _awaited(self) -> bool:
        """Whether a plan has to wait for somebody who is being stopped."""
        return any(
            record.phase is Phase.HOLDING
            and self.books.ledger.route(record.id)
            and self._now - record.held_at < self.settings.hold_timeout
            for record in self.books.robots.values()
        )

    def _finished(self) -> bool:
        return all(
            len(self.books.ledger.route(record.id)) == 1 and record.centred
            for record in self.books.robots.values()
            if record.phase is Phase.ACTIVE
        )

    def _plan(self) -> None:
        joint = plan_together(self.books, self.settings, self._attempt)
        self._attempt += 1
        # A plan that gets nearer is followed by another; one that gets nowhere waits for something to change.
        self._partial = not joint.complete and len(joint.steps) > 1
        self._outdated = False
        self._changed = True

    # -- small things -----------------------------------------------------------------------------------

    def _gone(self, robot: str) -> bool:
        """Whether a robot was removed just now."""
        return self._now < self._deaf_until.get(robot, self._now)

    def _record(self, robot: str) -> RobotRecord:
        record = self.books.robots.get(robot)
        if record is None:
            record = self.books.robots[robot] = RobotRecord(
                robot, self._first_revision, posed_at=self._now, reported_at=self._now
            )
            self._hold(record, "new")
        return record

    def _send(self, record: RobotRecord, cells: tuple[int, ...]) -> None:
        record.sent_at = self._now
        if record.phase is Phase.HOLDING:
            self._out.append(SendCancel(record.id))
        self._out.append(SendCells(record.id, record.next_revision(), cells))
        self._changed = True

    def _touched(self, record: RobotRecord) -> set[int]:
        reach = self.settings.robot_radius + self.settings.clearance
        return self.books.grid.cells_touched(record.x, record.y, reach)
