"""Gives robots that stand still their cells."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.progress import standing_cell
from rce_fleet.coordination.refusals import hindrance
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.coordination.dispatcher import Dispatcher
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings


class Placement:
    """Places robots that were stopped in the cells that they stand in.

    Attributes:
        to_settle: Robots that may stand still now.

    Args:
        state: The fleet.
        settings: Sizes and times.
        dispatcher: Sends robots their cells and has paths made.
    """

    def __init__(self, state: FleetState, settings: FleetSettings, dispatcher: Dispatcher) -> None:
        self._state = state
        self._settings = settings
        self._dispatcher = dispatcher
        self.to_settle: set[str] = set()

    def settle_standing(self) -> Iterator[set[int]]:
        """Place robots that stand still, and then those that waited for one of their cells.

        Yields:
            Cells that lost their owner since the last call or the set before.
        """
        state = self._state
        while True:
            freed = state.ledger.take_freed()
            yield freed
            candidates = self.to_settle | state.index.hindered_at(freed)
            self.to_settle = set()
            if not candidates:
                return
            for robot in sorted(candidates):
                record = state.robots.get(robot)
                if record is None or record.phase is not Phase.HOLDING:
                    continue
                if record.stands(self._settings) and state.mode_of(record).is_placed:
                    self._settle(record)
                else:
                    state.index.set_hindered(robot, ())

    def touched(self, record: RobotRecord) -> set[int]:
        """Return the cells that a robot overlaps at its last pose, with a margin."""
        is_manual = self._state.mode_of(record) is RobotMode.MANUAL
        margin = self._settings.manual_clearance if is_manual else self._settings.clearance
        return self._overlapped(record, self._settings.robot_radius + margin)

    def hull(self, record: RobotRecord) -> set[int]:
        """Return the cells that a robot's hull itself overlaps at its last pose."""
        return self._overlapped(record, self._settings.robot_radius)

    def _overlapped(self, record: RobotRecord, reach: float) -> set[int]:
        return self._state.grid.cells_touched(record.x, record.y, reach)

    def _settle(self, record: RobotRecord) -> None:
        """Place a robot that stands still in its cell."""
        state, dispatcher = self._state, self._dispatcher
        cell, own, reason = self._place_of(record)
        state.index.set_hindered(record.id, self.touched(record) if reason else ())
        if cell is None or reason:
            if record.reason != reason:
                record.reason = reason
                state.touch(record)
                self._ask_for_room(record)
            return
        is_driven = state.mode_of(record) is RobotMode.AUTOMATIC
        state.change(record, Cause.SETTLED if is_driven else Cause.STAYED, "" if is_driven else record.reason)
        record.centred = False
        # A blocked cell is not claimed: the robot only touches the margin around the box.
        state.ledger.place(record.id, cell, {other for other in own if not state.is_blocked(other)})
        if is_driven:
            dispatcher.require([record.id])
            dispatcher.send(record, (cell,))
        else:
            record.reason = state.reason_of(record)
            dispatcher.avoid(record)
        dispatcher.arrive(record)

    def _ask_for_room(self, record: RobotRecord) -> None:
        """Have robots without a goal leave the cells that a robot needs to be placed."""
        state = self._state
        for cell in () if isnan(record.x) else self.hull(record):
            owner = state.ledger.owner(cell)
            other = state.robots.get(owner) if owner is not None else None
            if other is not None and other is not record and other.goal is None:
                self._dispatcher.require([other.id])

    def _place_of(self, record: RobotRecord) -> tuple[int | None, set[int], str]:
        """Return the cell for a robot that stands still, its other cells too, and why it cannot have them."""
        state = self._state
        own = {cell for cell in self.touched(record) if state.ledger.owner(cell) in (None, record.id)}
        shut = {cell for cell in own if state.is_shut(cell)}
        cell = standing_cell(state.grid, own, record.x, record.y, shut)
        return cell, own, hindrance(state, record, self.hull(record), own, cell)

    def validate(self) -> None:
        """Check that every robot that stands still was placed.

        Raises:
            InvariantError: One was not.
        """
        for record in self._state.robots.values():
            stands = record.phase is Phase.HOLDING and record.stands(self._settings)
            is_placed = self._state.mode_of(record).is_placed
            if stands and is_placed and not self._place_of(record)[2]:
                raise InvariantError(f"{record.id} stands still and was not placed in its cell")
