"""Carries out what the fleet's state requires: stops and places robots, grants cells, requests plans.

The planner handles events and records their changes; :meth:`Dispatcher.advance` then does everything that has
become possible. It finds that by the indexes of the state and of the ledger, so the cost of an event does not
depend on the number of robots.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.events import BlockedChanged, Instruction, MakePlan, SendCancel, SendCells
from rce_fleet.coordination.fleet_state import FleetState
from rce_fleet.coordination.progress import arrived_index, standing_cell
from rce_fleet.coordination.refusals import hindrance
from rce_fleet.coordination.replanning import PlanAdoption, PlanRequest, PlanResult, request_plan
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from rce_fleet.coordination.settings import FleetSettings


class Dispatcher:
    """Moves the robots of a fleet on.

    Attributes:
        now: Time of the current event, seconds.
        out: Its instructions so far.
        outdated: Whether the state changed since the newest plan or plan request.
        to_settle: Robots that may stand still now.
        left: Pending cells that may be free of robots now.

    Args:
        state: The fleet.
        settings: Sizes and times.
    """

    def __init__(self, state: FleetState, settings: FleetSettings) -> None:
        self.state = state
        self.settings = settings
        self.now = 0.0
        self.out: list[Instruction] = []
        self.outdated = False
        self.to_settle: set[str] = set()
        self.left: set[int] = set()
        self._partial = False
        self._asked: PlanRequest | None = None
        self._plans = 0
        self._adoption: PlanAdoption | None = None
        self._ripe: set[str] = set()
        """Robots that may be granted further cells, and had no turn yet."""

    def advance(self) -> None:
        """Do everything that has become possible."""
        self._settle_standing()
        self._block_left_cells()
        if self._adoption is not None:
            self._take_over(self._adoption)
        self.state.refresh()
        if self._asked is None:
            if self._partial and not self.state.index.under_way:
                self.outdated = True
            if not self.outdated:
                self._grant()
                self.state.refresh()
            elif not self._awaited():
                self._ask_for_plan()

    def is_taking_over(self) -> bool:
        """Return whether the rest of a plan, or of its first grants, follows with the next events."""
        return self._adoption is not None or bool(self._ripe)

    def hold(self, record: RobotRecord, reason: str) -> None:
        """Stop a robot, to take its cells back once it stands still."""
        if record.phase is Phase.SILENT:
            return
        record.held_at = self.now
        self.state.change(record, Cause.HELD, reason)
        if self.state.ledger.length(record.id):
            self.state.ledger.truncate(record.id)
        self.outdated = True
        self.send(record, ())

    def _settle_standing(self) -> None:
        """Place robots that stand still, and then those that waited for one of their cells."""
        while True:
            freed = self.state.ledger.take_freed()
            self.left |= freed
            candidates = self.to_settle | self.state.index.hindered_at(freed)
            self.to_settle = set()
            if not candidates:
                return
            for robot in sorted(candidates):
                record = self.state.robots.get(robot)
                if record is None or record.phase is not Phase.HOLDING:
                    continue
                if record.stands(self.settings):
                    self._settle(record)
                else:
                    self.state.index.set_hindered(robot, ())

    def _settle(self, record: RobotRecord) -> None:
        """Place a robot that stands still in its cell."""
        state = self.state
        cell, own, reason = self._place_of(record)
        state.index.set_hindered(record.id, self.touched(record) if reason else ())
        if cell is None or reason:
            if record.reason != reason:
                record.reason = reason
                state.touch(record)
            return
        state.change(record, Cause.SETTLED, "")
        record.centred = False
        # A blocked cell is not claimed: the robot only touches the margin around the box.
        state.ledger.place(record.id, cell, {other for other in own if not state.is_blocked(other)})
        self.outdated = True
        self.send(record, (cell,))
        self.arrive(record)

    def _place_of(self, record: RobotRecord) -> tuple[int | None, set[int], str]:
        """Return the cell for a robot that stands still, its other cells too, and why it cannot have them."""
        state = self.state
        touched = self.touched(record)
        own = {cell for cell in touched if state.ledger.owner(cell) in (None, record.id)}
        shut = {cell for cell in own if state.is_shut(cell)}
        cell = standing_cell(state.grid, own, record.x, record.y, shut)
        return cell, own, hindrance(state, record, touched, own, cell)

    def _block_left_cells(self) -> None:
        left, self.left = self.left & self.state.pending, set()
        free = [cell for cell in left if self.state.ledger.owner(cell) is None]
        for cell in free:
            self.state.block(cell)
        if free:
            self.out.append(BlockedChanged(tuple(sorted(self.state.blocked))))

    def _grant(self) -> None:
        """Grant cells to robots whose turn it may be; to some of them, if there are many."""
        ledger = self.state.ledger
        self._ripe |= ledger.take_ripe()
        turn = sorted(self._ripe)[: self.settings.robots_per_step]
        self._ripe.difference_update(turn)
        for robot in turn:
            record = self.state.robots.get(robot)
            if record is None or record.phase is not Phase.ACTIVE:
                continue
            if ledger.grant(robot, self.settings.ahead):
                self.send(record, tuple(ledger.granted(robot)))

    # Plans

    def _awaited(self) -> bool:
        """Return whether a plan has to wait for a robot that is stopping."""
        told_at = self.state.index.last_stop()
        return told_at is not None and self.now - told_at < self.settings.hold_timeout

    def _ask_for_plan(self) -> None:
        self._asked = request_plan(self.state, self.settings, self._plans)
        self._plans += 1
        self.outdated = self._partial = False
        self.out.append(MakePlan(self._asked))

    def take_plan(self, result: PlanResult) -> None:
        """Begin to take over the requested plan; ignore any other."""
        request = self._asked
        if request is None or request.number != result.number or self._adoption is not None:
            return
        if self.outdated and self._awaited():
            self._asked = None
            return
        self._adoption = PlanAdoption(self.state, request, result)
        # After a plan that makes progress, request another; otherwise wait for a change.
        self._partial = not result.complete and bool(result.cells)

    def _take_over(self, adoption: PlanAdoption) -> None:
        """Take over the next part of a plan; the part after it follows with the next event."""
        if not adoption.step(self.settings.visits_per_step):
            return
        self._asked = self._adoption = None
        if self.outdated and not self._awaited():
            self._grant()

    # One robot

    def arrive(self, record: RobotRecord) -> bool:
        """Release the cells that a robot has left; return whether it is on its path."""
        granted = self.state.ledger.granted(record.id)
        index = arrived_index(self.state.grid, granted, record.x, record.y, self.settings)
        if index is None:
            return False
        if index > 0 or not record.centred:
            record.centred = True
            self.state.touch(record)
            self.state.ledger.arrive(record.id, index)
        return True

    def send(self, record: RobotRecord, cells: tuple[int, ...]) -> None:
        """Send a robot its cells; stop it first if it must stand still."""
        record.sent_at = self.now
        if record.phase is Phase.HOLDING:
            self.out.append(SendCancel(record.id))
        self.out.append(SendCells(record.id, record.next_revision(), cells))

    def touched(self, record: RobotRecord) -> set[int]:
        """Return the cells that a robot overlaps at its last pose."""
        reach = self.settings.robot_radius + self.settings.clearance
        return self.state.grid.cells_touched(record.x, record.y, reach)

    def validate(self) -> None:
        """Check that everything that is possible was done.

        Raises:
            InvariantError: Something was not done.
        """
        state, quiet = self.state, not self.outdated and self._asked is None and not self._ripe
        for record in state.robots.values():
            stands = record.phase is Phase.HOLDING and record.stands(self.settings)
            if stands and not self._place_of(record)[2]:
                raise InvariantError(f"{record.id} stands still and was not placed in its cell")
            is_granted_cells = quiet and record.phase is Phase.ACTIVE
            if is_granted_cells and state.ledger.may_grant(record.id, self.settings.ahead):
                raise InvariantError(f"{record.id} was not granted a cell that is free for it")
        undone = [cell for cell in state.pending if state.ledger.owner(cell) is None]
        if undone:
            raise InvariantError(f"cells {undone} are free and were not blocked")
