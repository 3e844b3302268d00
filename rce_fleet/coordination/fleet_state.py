"""The planner's state: records of the robots, blocked cells, the ledger and the indexes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce_fleet.coordination.cell_blocks import CellBlock
from rce_fleet.coordination.changes import ChangeLog, FleetChanges
from rce_fleet.coordination.indexes import FleetIndex
from rce_fleet.coordination.ledger import CellLedger
from rce_fleet.coordination.modes import RobotMode, effective_mode
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.coordination.snapshot import FleetSnapshot, RobotSnapshot, RobotState
from rce_fleet.coordination.zones import Zone, ZoneBook, union_of
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rce_fleet.planning.grid import GridMap


@dataclass(slots=True)
class FleetState:
    """The fleet's state.

    Records are changed in place: call :meth:`touch` after a change, and :meth:`refresh` before reading
    indexes. The ledger records its own changes.

    Attributes:
        grid: The map; its blocked cells are walls.
        robots: All robots that sent a message and were not removed.
        ledger: Which robot claims which cell.
        blocked: Cells that were blocked; no robot claims one.
        pending: Cells that will be blocked once no robot claims them; no robot may enter one.
        sensed: Those of both that robots' sensors found blocked, and people did not; with who, and when.
        requested: Those of both that people blocked one by one; with who, why and until when.
        zones: Zones of the map, and lanes.
        mode: The fleet's mode; counts for robots whose own mode is automatic.
        mode_reason: Why the fleet has its mode, and who set it.
        map_version: Changes when cells, zones or robots' costs in zones do.
        learned: Steps that moves take for which robots waited of late, see
            :mod:`rce_fleet.coordination.congestion`; empty: nothing is learned.
        index: Indexes of the robots.
        log: Changes that are not published yet.
    """

    grid: GridMap
    robots: dict[str, RobotRecord] = field(default_factory=dict)
    ledger: CellLedger = field(default_factory=CellLedger)
    blocked: set[int] = field(default_factory=set)
    pending: set[int] = field(default_factory=set)
    sensed: dict[int, CellBlock] = field(default_factory=dict)
    requested: dict[int, CellBlock] = field(default_factory=dict)
    zones: ZoneBook = field(default_factory=ZoneBook)
    mode: RobotMode = RobotMode.AUTOMATIC
    mode_reason: str = ""
    map_version: int = 0
    learned: dict[tuple[int, int], int] = field(default_factory=dict)
    index: FleetIndex = field(default_factory=FleetIndex)
    log: ChangeLog = field(default_factory=ChangeLog)
    _touched: set[str] = field(default_factory=set)

    @property
    def shut(self) -> frozenset[int]:
        """Cells that no robot may enter."""
        return self.grid.blocked.union(self.blocked, self.pending)

    def is_shut(self, cell: int) -> bool:
        """Return whether robots may not enter a cell."""
        return cell in self.grid.blocked or cell in self.blocked or cell in self.pending

    def is_blocked(self, cell: int) -> bool:
        """Return whether a cell is a wall or blocked already."""
        return cell in self.grid.blocked or cell in self.blocked

    def forbidden(self, robot: str, users: Callable[[Zone], set[str]] | None = None) -> frozenset[int]:
        """Return the cells that one robot may not enter, of those that are open to others.

        Args:
            robot: The robot.
            users: Returns the robots in a zone or with a path into it, if that is known already.
        """
        zones = self.zones
        return union_of([zones.forbidden(robot), zones.full(robot, users or self.zone_users)])

    def closed(self, robot: str) -> frozenset[tuple[int, int]]:
        """Return the moves ``(from, to)`` that a robot may not make."""
        common, own = self.zones.closed(self.grid), self.zones.closed_for(robot, self.grid)
        return common | own if own else common

    def move_costs(self) -> Mapping[tuple[int, int], int]:
        """Return the steps that moves take in new paths, where it is not 1: of lanes, and learned ones."""
        lanes = self.zones.move_costs
        if not self.learned:
            return lanes
        return {**lanes, **{move: max(cost, lanes.get(move, 1)) for move, cost in self.learned.items()}}

    def zone_users(self, zone: Zone) -> set[str]:
        """Return the robots that claim a cell of a zone or have a path into it."""
        found: set[str] = set()
        for cell in zone.cells:
            found |= self.ledger.visitors(cell)
            owner = self.ledger.owner(cell)
            if owner is not None:
                found.add(owner)
        return found

    def has_reason(self, cell: int) -> bool:
        """Return whether there is a reason to keep a cell blocked."""
        return cell in self.sensed or cell in self.requested or self.zones.blocks(cell) is not None

    def block_of(self, cell: int) -> CellBlock | None:
        """Return who blocked a cell, and why; None: at most a zone did."""
        return self.requested.get(cell) or self.sensed.get(cell)

    def mode_of(self, record: RobotRecord) -> RobotMode:
        """Return the mode of a robot that counts."""
        mode = effective_mode(self.mode, record.mode)
        return RobotMode.LOST if record.lost and mode is RobotMode.AUTOMATIC else mode

    def reason_of(self, record: RobotRecord) -> str:
        """Return why a robot has the mode that counts, for people."""
        if self.mode_of(record) is RobotMode.LOST:
            return record.lost
        return record.mode_reason if self.mode_of(record) is record.mode else self.mode_reason

    # Changes

    def touch(self, record: RobotRecord) -> None:
        """Note that a record was changed."""
        self._touched.add(record.id)

    def change(self, record: RobotRecord, cause: Cause, reason: str) -> None:
        """Change a robot's phase.

        Raises:
            TransitionError: The phase does not allow the cause.
        """
        record.change(cause)
        record.reason = reason
        self._touched.add(record.id)

    def remove(self, robot: str) -> None:
        """Remove a robot; its cells are free."""
        del self.robots[robot]
        self.ledger.remove(robot)
        self._touched.add(robot)

    def want_blocked(self, cell: int) -> None:
        """Make a cell pending: no robot may enter it from now on."""
        self.pending.add(cell)
        self.map_version += 1
        self.log.note_cell(cell)

    def block(self, cell: int) -> None:
        """Block a cell that no robot claims."""
        self.pending.discard(cell)
        self.blocked.add(cell)
        self.map_version += 1
        self.log.note_cell(cell)

    def put_block(self, cell: int, block: CellBlock) -> None:
        """Note who blocked a cell, and why; a sensor does not take over what a person blocked."""
        if not block.sensed:
            self.sensed.pop(cell, None)
        (self.sensed if block.sensed else self.requested)[cell] = block
        self.log.note_cell(cell)

    def drop_block(self, cell: int) -> None:
        """Note that neither a person nor a sensor blocks a cell; a zone may."""
        self.sensed.pop(cell, None)
        self.requested.pop(cell, None)
        self.log.note_cell(cell)

    def free(self, cell: int) -> None:
        """Let robots enter a cell again."""
        self.pending.discard(cell)
        self.blocked.discard(cell)
        self.drop_block(cell)
        self.map_version += 1

    def refresh(self) -> None:
        """Update the indexes with the changes since the last call."""
        touched = self.ledger.take_changed() | self._touched
        if not touched:
            return
        self._touched = set()
        for robot in sorted(touched, key=self._held_at):
            self.log.note_robot(robot)
            record = self.robots.get(robot)
            if record is None:
                self.index.leave(robot)
            else:
                self.index.enter(record, self.ledger)

    def _held_at(self, robot: str) -> float:
        record = self.robots.get(robot)
        return record.held_at if record else 0.0

    # Publishing

    def take_changes(self) -> FleetChanges | None:
        """Return the changes that are not published yet; None if there are none."""
        return self.log.take(self.describe, self._cell_state, self.zones.zones, self.block_of)

    def snapshot(self) -> FleetSnapshot:
        """Return the state for publishing."""
        return FleetSnapshot(
            robots=tuple(self._describe(self.robots[robot]) for robot in sorted(self.robots)),
            blocked=tuple(sorted(self.blocked)),
            pending=tuple(sorted(self.pending)),
            blocks=tuple(sorted((self.sensed | self.requested).items())),
        )

    def describe(self, robot: str) -> RobotSnapshot | None:
        """Return a robot's state for publishing; None if the robot is unknown."""
        record = self.robots.get(robot)
        return None if record is None else self._describe(record)

    def validate(self) -> None:
        """Check the invariants.

        Raises:
            InvariantError: An invariant does not hold.
        """
        self.ledger.validate()
        self.index.validate(self.robots.values(), self.ledger)
        if self.blocked & (self.pending | self.grid.blocked) or self.pending & self.grid.blocked:
            raise InvariantError("a cell is a wall, blocked or pending, and only one of these")
        self._validate_blocks()
        for record in self.robots.values():
            route, claims = self.ledger.route(record.id), self.ledger.claims(record.id)
            if not self.grid.is_path(route):
                raise InvariantError(f"the route of {record.id} is not a path: {route}")
            if route and claims & self.blocked:
                raise InvariantError(f"{record.id} claims blocked cells: {claims & self.blocked}")
            if record.phase not in (Phase.ACTIVE, Phase.STANDING):
                continue
            if not route:
                raise InvariantError(f"{record.id} is active without a cell")
            if self.shut.intersection(route[1:]):
                raise InvariantError(f"the route of {record.id} leads through blocked cells: {route}")

    def _validate_blocks(self) -> None:
        for what, blocks in (("sensed", self.sensed), ("requested", self.requested)):
            if not blocks.keys() <= self.blocked | self.pending:
                raise InvariantError(f"cells {sorted(blocks)} were {what} and are not all blocked or pending")
        if both := self.sensed.keys() & self.requested.keys():
            raise InvariantError(f"cells {sorted(both)} were both sensed and requested")

    def _cell_state(self, cell: int) -> bool | None:
        """Return whether a cell is blocked (True), pending (False) or neither (None)."""
        return True if cell in self.blocked else False if cell in self.pending else None

    def _describe(self, record: RobotRecord) -> RobotSnapshot:
        route = self.ledger.route(record.id)
        state = self._state_of(record, route)
        return RobotSnapshot(
            id=record.id,
            state=state,
            reason=record.reason or (_why_waits(record, route) if state is RobotState.WAITING else ""),
            x=record.x,
            y=record.y,
            yaw=record.yaw,
            cell=route[0] if route else None,
            goal=record.goal,
            plan=tuple(route),
            granted=tuple(self.ledger.granted(record.id)),
            replans=record.replans,
            mode=effective_mode(self.mode, record.mode).value,
            pose_only=record.pose_only,
        )

    def _state_of(self, record: RobotRecord, route: list[int]) -> RobotState:
        mode = self.mode_of(record)
        is_followed = mode.is_followed and not route
        if record.phase is Phase.STANDING or (is_followed and record.phase is Phase.HOLDING):
            return RobotState(mode.value)
        if record.phase is Phase.HOLDING and mode is RobotMode.LOST:
            return RobotState.LOST
        if record.phase is Phase.SILENT:
            return RobotState.DEAD if mode is RobotMode.DEAD else RobotState.SILENT
        if record.phase is Phase.HOLDING:
            return RobotState.STOPPING if route else RobotState.JOINING
        return self._state_of_active(record, route)

    def _state_of_active(self, record: RobotRecord, route: list[int]) -> RobotState:
        if len(self.ledger.granted(record.id)) > 1 or not record.centred:
            return RobotState.DRIVING
        if len(route) > 1:
            return RobotState.WAITING
        if record.unreachable:
            return RobotState.WAITING if record.full_zone else RobotState.UNREACHABLE
        return _AT_REST[record.goal is not None, route == [record.goal]]


def _why_waits(record: RobotRecord, route: list[int]) -> str:
    """Return why a robot waits, if it is not for others to leave its path, for people."""
    if record.full_zone:
        return f"zone {record.full_zone!r} is full"
    return record.no_path if len(route) == 1 else ""


_AT_REST = {
    (False, False): RobotState.IDLE,
    (True, False): RobotState.WAITING,
    (True, True): RobotState.ARRIVED,
}
"""State of a robot at rest in its cell, by whether it has a goal and is there."""
