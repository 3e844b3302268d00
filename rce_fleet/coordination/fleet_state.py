"""All that the planner remembers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce_fleet.coordination.ledger import CellLedger
from rce_fleet.coordination.robot import Phase, RobotRecord
from rce_fleet.coordination.snapshot import FleetSnapshot, RobotSnapshot, RobotState
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap


@dataclass(slots=True)
class FleetState:
    """The fleet's state.

    Attributes:
        grid: The map; its blocked cells are walls.
        robots: Every robot ever heard and not removed.
        ledger: Who claims which cell.
        blocked: Cells that were blocked; nobody claims one.
        pending: Cells that will be blocked when those who claim them have left; nobody may enter one.
    """

    grid: GridMap
    robots: dict[str, RobotRecord] = field(default_factory=dict)
    ledger: CellLedger = field(default_factory=CellLedger)
    blocked: set[int] = field(default_factory=set)
    pending: set[int] = field(default_factory=set)

    @property
    def shut(self) -> frozenset[int]:
        """Cells that nobody may enter."""
        return self.grid.blocked.union(self.blocked, self.pending)

    def in_phase(self, phase: Phase) -> list[RobotRecord]:
        """Robots in a phase of their lives."""
        return [record for record in self.robots.values() if record.phase is phase]

    def snapshot(self) -> FleetSnapshot:
        """The state as the outside sees it."""
        return FleetSnapshot(
            robots=tuple(self._describe(self.robots[robot]) for robot in sorted(self.robots)),
            blocked=tuple(sorted(self.blocked)),
            pending=tuple(sorted(self.pending)),
        )

    def validate(self) -> None:
        """Check the invariants.

        Raises:
            InvariantError: One does not hold.
        """
        self.ledger.validate()
        if self.blocked & (self.pending | self.grid.blocked) or self.pending & self.grid.blocked:
            raise InvariantError("a cell is a wall, blocked or pending, and only one of these")
        for record in self.robots.values():
            route, claims = self.ledger.route(record.id), self.ledger.claims(record.id)
            if not self.grid.is_path(route):
                raise InvariantError(f"the route of {record.id} is no path: {route}")
            if route and claims & self.blocked:
                raise InvariantError(f"{record.id} claims blocked cells: {claims & self.blocked}")
            if record.phase is not Phase.ACTIVE:
                continue
            if not route:
                raise InvariantError(f"{record.id} is active without a cell")
            if self.shut.intersection(route[1:]):
                raise InvariantError(f"the route of {record.id} leads through blocked cells: {route}")

    def _describe(self, record: RobotRecord) -> RobotSnapshot:
        route = self.ledger.route(record.id)
        return RobotSnapshot(
            id=record.id,
            state=self._state_of(record, route),
            reason=record.reason,
            x=record.x,
            y=record.y,
            yaw=record.yaw,
            cell=route[0] if route else None,
            goal=record.goal,
            plan=tuple(route),
            granted=tuple(self.ledger.granted(record.id)),
            replans=record.replans,
        )

    def _state_of(self, record: RobotRecord, route: list[int]) -> RobotState:
        if record.phase is Phase.SILENT:
            return RobotState.SILENT
        if record.phase is Phase.HOLDING:
            return RobotState.STOPPING if route else RobotState.JOINING
        if len(self.ledger.granted(record.id)) > 1 or not record.centred:
            return RobotState.DRIVING
        if len(route) > 1:
            return RobotState.WAITING
        if record.unreachable:
            return RobotState.UNREACHABLE
        return _AT_REST[record.goal is not None, route == [record.goal]]


_AT_REST = {
    (False, False): RobotState.IDLE,
    (True, False): RobotState.WAITING,
    (True, True): RobotState.ARRIVED,
}
"""State of a robot that stands in its cell, by whether it has a goal and is there."""
