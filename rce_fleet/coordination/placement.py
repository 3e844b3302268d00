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
    from collections.abc import Iterable, Iterator

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

        Before that, free cells are claimed for the robots that overlap them already.

        Yields:
            Cells that lost their owner since the last call or the set before.
        """
        state = self._state
        while True:
            freed = state.ledger.take_freed()
            yield freed
            displaced = state.index.displaced.at(freed) & state.robots.keys()
            for robot in sorted(displaced):
                self._dispatcher.watch(state.robots[robot])
            candidates = self.to_settle | state.index.hindered.at(freed)
            self.to_settle = set()
            if not candidates and not displaced:
                return
            for robot in sorted(candidates):
                record = state.robots.get(robot)
                if record is None or record.phase is not Phase.HOLDING:
                    continue
                if record.stands(self._settings) and state.mode_of(record).is_placed:
                    self._settle(record)
                else:
                    state.index.hindered.put(robot, ())

    def touched(self, record: RobotRecord) -> set[int]:
        """Return the cells that a robot overlaps at its last pose, with a margin."""
        is_manual = self._state.mode_of(record) is RobotMode.MANUAL
        margin = self._settings.manual_clearance if is_manual else self._settings.clearance
        return self._overlapped(record, self._settings.robot_radius + margin)

    def hull(self, record: RobotRecord) -> set[int]:
        """Return the cells that a robot's hull itself overlaps at its last pose."""
        return self._overlapped(record, self._settings.robot_radius)

    def nearest(self, record: RobotRecord) -> int | None:
        """Return the cell for a robot at its last pose, among those that other robots do not claim."""
        return self._place_of(record)[2]

    def _overlapped(self, record: RobotRecord, reach: float) -> set[int]:
        return self._state.grid.cells_touched(record.x, record.y, reach)

    def _settle(self, record: RobotRecord) -> None:
        """Place a robot that stands still in its cell."""
        state, dispatcher = self._state, self._dispatcher
        hull, own, cell, reason = self._place_of(record)
        state.index.hindered.put(record.id, self.touched(record) if reason else ())
        if cell is None or reason:
            if record.reason != reason:
                record.reason = reason
                state.touch(record)
                self._ask_for_room(record)
            dispatcher.make_room(record)
            if not hull <= own:
                self._give_back(record, cell, own)
            return
        is_driven = state.mode_of(record) is RobotMode.AUTOMATIC
        state.change(record, Cause.SETTLED if is_driven else Cause.STAYED, "" if is_driven else record.reason)
        record.centred, record.doubted = False, frozenset()
        state.ledger.place(record.id, cell, self._open(own))
        if is_driven:
            dispatcher.require([record.id])
            dispatcher.send(record, (cell,))
        else:
            record.reason = state.reason_of(record)
            dispatcher.avoid(record)
        dispatcher.arrive(record)

    def _open(self, cells: Iterable[int]) -> set[int]:
        """Return the cells that may be claimed: of a blocked one, robots touch the margin around the box."""
        return {cell for cell in cells if not self._state.is_blocked(cell)}

    def _give_back(self, record: RobotRecord, cell: int | None, own: set[int]) -> None:
        """Take from a robot that waits for a place all cells but those that it overlaps.

        It stands, so it does not drive to the others. Another robot may wait for them, and this one for that.
        """
        ledger = self._state.ledger
        if not ledger.length(record.id):
            return
        if cell is None:
            ledger.unplace(record.id)
        elif not self._state.is_blocked(cell) and ledger.claims(record.id) != self._open(own):
            ledger.place(record.id, cell, self._open(own))

    def _ask_for_room(self, record: RobotRecord) -> None:
        """Have robots without a goal leave the cells that a robot needs to be placed."""
        state = self._state
        for cell in () if isnan(record.x) else self.hull(record):
            owner = state.ledger.owner(cell)
            other = state.robots.get(owner) if owner is not None else None
            if other is not None and other is not record and other.goal is None:
                self._dispatcher.require([other.id])

    def _place_of(self, record: RobotRecord) -> tuple[set[int], set[int], int | None, str]:
        """Return where a robot that stands still can be placed.

        Returns:
            The cells of its hull; the cells that it overlaps and may claim; its cell; why it cannot have it.
        """
        state, hull = self._state, self.hull(record)
        own = {cell for cell in self.touched(record) if state.ledger.owner(cell) in (None, record.id)}
        shut = {cell for cell in own if state.is_shut(cell)}
        cell = standing_cell(state.grid, own, record.x, record.y, shut)
        reachable = {other for other in hull - own if self._may_drive_to(other)}
        return hull, own, cell, hindrance(state, record, hull, own, cell, reachable)

    def _may_drive_to(self, cell: int) -> bool:
        """Return whether a cell's owner is elsewhere, and may drive there."""
        owner = self._state.ledger.owner(cell)
        record = self._state.robots.get(owner) if owner is not None else None
        return record is not None and (isnan(record.x) or cell not in self.touched(record))

    def validate(self) -> None:
        """Check that every robot that stands still was placed.

        Raises:
            InvariantError: One was not.
        """
        for record in self._state.robots.values():
            stands = record.phase is Phase.HOLDING and record.stands(self._settings)
            is_placed = self._state.mode_of(record).is_placed
            if stands and is_placed and not self._place_of(record)[-1]:
                raise InvariantError(f"{record.id} stands still and was not placed in its cell")
