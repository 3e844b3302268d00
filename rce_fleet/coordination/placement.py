"""Gives robots that stand still their cells."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, isnan
from typing import TYPE_CHECKING, NamedTuple

from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.progress import standing_cell
from rce_fleet.coordination.refusals import hindrance
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rce_fleet.coordination.dispatcher import Dispatcher
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings


UNSEEN = "no pose shows that it stopped: localize it twice, or drive it by hand; it keeps its cells till then"
_ROUNDING = 1e-6
_SAMPLES = 20
"""Places on a way at which the cells that a robot overlaps are looked at: one in 5 cm of a cell of 1 m."""
_BETWEEN_SAMPLES = 0.01
"""Margin for what a robot overlaps between two of these places, metres."""


class _Entry(NamedTuple):
    """How a robot that stands gets into a cell.

    Attributes:
        cell: The cell; None: it has to wait.
        swept: Cells that it overlaps on the way there.
        reason: Why it has to wait.
    """

    cell: int | None
    swept: frozenset[int] = frozenset()
    reason: str = ""


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

    def swept(self, record: RobotRecord, cell: int) -> set[int]:
        """Return the cells that a robot overlaps on its straight way to the centre of one."""
        grid, (x, y) = self._state.grid, self._state.grid.centre(cell)
        shares = [number / _SAMPLES for number in range(_SAMPLES + 1)]
        places = [(record.x + share * (x - record.x), record.y + share * (y - record.y)) for share in shares]
        reach = self._settings.robot_radius + _BETWEEN_SAMPLES
        return set().union(*(grid.cells_touched(*place, reach) for place in places))

    def nearest(self, record: RobotRecord) -> int | None:
        """Return the cell for a robot at its last pose, among those that other robots do not claim."""
        return self._place_of(record)[2]

    def _overlapped(self, record: RobotRecord, reach: float) -> set[int]:
        return self._state.grid.cells_touched(record.x, record.y, reach)

    def _settle(self, record: RobotRecord) -> None:
        """Place a robot that stands still in its cell."""
        state, dispatcher = self._state, self._dispatcher
        hull, own, cell, reason = self._place_of(record)
        entry = self._entry(record, hull, own, cell) if cell is not None and not reason else _Entry(cell)
        reason = reason or entry.reason
        state.index.hindered.put(record.id, self.touched(record) if reason else ())
        if cell is None or entry.cell is None or reason:
            if record.reason != reason:
                record.reason = reason
                state.touch(record)
                self._ask_for_room(record)
            dispatcher.make_room(record)
            if not hull <= own and not self._would_lose(record, own, cell):
                self._give_back(record, cell, own)
            return
        is_driven = state.mode_of(record) is RobotMode.AUTOMATIC
        state.change(record, Cause.SETTLED if is_driven else Cause.STAYED, "" if is_driven else record.reason)
        record.earlier = frozenset()
        record.centred, record.leaving, record.doubted = False, entry.cell != cell, frozenset()
        state.ledger.place(record.id, entry.cell, self._open({cell, *own, *entry.swept}))
        if is_driven:
            dispatcher.require([record.id])
            dispatcher.send(record, (entry.cell,))
        else:
            record.reason = state.reason_of(record)
            dispatcher.avoid(record)
        dispatcher.arrive(record)

    def _would_lose(self, record: RobotRecord, own: set[int], cell: int | None) -> bool:
        """Return whether a robot whose poses may have ended would lose cells that it may still drive to.

        Of a move client that answers nothing only a pose shows that it stopped. Cells behind are not entered.
        """
        if not record.pose_only or record.shows_rest(self._settings):
            return False
        ledger = self._state.ledger
        granted = ledger.granted(record.id)
        may_drive = len(granted) > 1 or (granted and not record.centred)
        ahead = ledger.claims(record.id) if may_drive else frozenset[int]()
        if cell in granted and not record.leaving:
            ahead = frozenset(granted[granted.index(cell) + 1 :])
        return not ahead | record.earlier <= own

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
        held = set() if self._holders_wait(record, hull - own) else hull - own
        reason = UNSEEN if self._would_lose(record, own, cell) else ""
        return hull, own, cell, reason or hindrance(state, record, hull, held, cell, reachable)

    def _holders_wait(self, record: RobotRecord, cells: Iterable[int]) -> bool:
        """Return whether the owners of cells stand there without a place: one of all has to leave first."""
        state = self._state
        owners = {state.ledger.owner(cell) for cell in cells}
        records = [state.robots.get(owner) for owner in owners if owner is not None]
        return not state.ledger.length(record.id) and all(
            other is not None and other.phase is Phase.HOLDING and not state.ledger.length(other.id)
            for other in records
        )

    # Robots in one cell

    def keeps_off(self, places: Sequence[tuple[float, float]], other: RobotRecord) -> bool:
        """Return whether a robot that drives straight from place to place keeps off one that stands.

        It may begin near it, if it does not come nearer.
        """
        begins = hypot(other.x - places[0][0], other.y - places[0][1])
        least = min(2 * self._settings.robot_radius + self._settings.clearance, begins)
        return all(_distance(a, b, (other.x, other.y)) >= least - _ROUNDING for a, b in pairwise(places))

    def beside(self, robot: str, cells: Iterable[int]) -> list[RobotRecord]:
        """Return other robots that overlap cells which are not theirs, and one of these cells."""
        displaced = self._state.index.displaced
        if not displaced.cells:
            return []
        wanted = set(cells)
        found = (self._state.robots.get(name) for name in sorted(displaced.at(wanted) - {robot}))
        return [other for other in found if other and not isnan(other.x) and wanted & self.hull(other)]

    def _entry(self, record: RobotRecord, hull: set[int], own: set[int], cell: int) -> _Entry:
        """Return how a robot gets into a cell of its own, if another one that waits is in its cell too.

        It leaves the cell straight, in a direction in which it comes no nearer, and the other one gets it.
        """
        state = self._state
        others = self.beside(record.id, {cell, *own})
        if not state.ledger.length(record.id):
            holders = {state.ledger.owner(other) for other in hull - own}
            others += [state.robots[name] for name in sorted(filter(None, holders)) if name in state.robots]
        if not others or self._state.mode_of(record) is not RobotMode.AUTOMATIC:
            return _Entry(cell)
        here, centre = (record.x, record.y), state.grid.centre
        is_shared = any(cell in self.hull(other) for other in others)
        if all(map(self._is_still, others)):
            for first in self._exits(record, cell) if is_shared else [cell]:
                swept = self.swept(record, first)
                if self._may_sweep(record, swept - own) and all(
                    self.keeps_off((here, centre(first)), other) for other in others
                ):
                    return _Entry(first, frozenset(swept))
        names = ", ".join(dict.fromkeys(other.id for other in others))
        return _Entry(None, reason=f"too near to {names} to leave cell {cell}: drive one of them by hand")

    def _is_still(self, record: RobotRecord) -> bool:
        """Return whether a robot stands, and is not about to drive."""
        granted = self._state.ledger.granted(record.id)
        may_drive = record.phase is Phase.ACTIVE and (len(granted) > 1 or not record.centred)
        return not may_drive and self._dispatcher.now - record.still_since() >= self._settings.settle_time

    def _exits(self, record: RobotRecord, cell: int) -> list[int]:
        """Return the cells beside one that a robot may enter, the nearest first."""
        state = self._state
        closed, forbidden = state.closed(record.id), state.forbidden(record.id)
        exits = [
            other
            for other in state.grid.around(cell)
            if not state.is_shut(other) and other not in forbidden and (cell, other) not in closed
        ]
        return sorted(exits, key=lambda other: hypot(*_minus(state.grid.centre(other), (record.x, record.y))))

    def _may_sweep(self, record: RobotRecord, cells: Iterable[int]) -> bool:
        """Return whether a robot may pass over cells: they are open, and no other robot may be there."""
        state = self._state
        return all(
            not state.is_blocked(cell)
            and state.ledger.owner(cell) in (None, record.id)
            and not state.index.displaced.at({cell}) - {record.id}
            for cell in cells
        )

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
            if not stands or not is_placed:
                continue
            hull, own, _, reason = self._place_of(record)
            # Beside others it waits until they stand, and is looked at with its next message.
            if not reason and not self.beside(record.id, own) and hull <= own:
                raise InvariantError(f"{record.id} stands still and was not placed in its cell")


def _distance(begin: tuple[float, float], end: tuple[float, float], place: tuple[float, float]) -> float:
    """Return the distance of a place from a straight way, metres."""
    (dx, dy), (x, y) = _minus(end, begin), _minus(place, begin)
    length = dx * dx + dy * dy
    share = min(max((x * dx + y * dy) / length, 0.0), 1.0) if length else 0.0
    return hypot(x - share * dx, y - share * dy)


def _minus(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    return a[0] - b[0], a[1] - b[1]
