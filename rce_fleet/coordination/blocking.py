"""Cells that people or robots' sensors block and free."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    ObstacleGone,
    ObstacleSeen,
    Reply,
)
from rce_fleet.coordination.refusals import refuse_block
from rce_fleet.coordination.robot import Phase

if TYPE_CHECKING:
    from rce_fleet.coordination.dispatcher import Dispatcher
    from rce_fleet.coordination.fleet_state import FleetState


class CellBlocking:
    """Blocks and frees cells, and stops the robots concerned.

    A cell that only sensors found blocked is freed when a sensor sees that nothing is there any more; one
    that a person blocked is freed by a person only.

    Args:
        state: The fleet's state.
        dispatcher: Stops robots and makes new plans.
    """

    def __init__(self, state: FleetState, dispatcher: Dispatcher) -> None:
        self._state = state
        self._dispatcher = dispatcher

    # What robots see

    def take_obstacle(self, event: ObstacleSeen) -> None:
        """Block the cells that a robot found blocked."""
        state = self._state
        for cell in event.cells:
            owner = state.ledger.owner(cell) if cell in state.grid else None
            standing = cell in state.ledger.route(event.robot)[:1]
            # In cells of other robots the sensor has seen these robots.
            if cell not in state.grid or owner not in (None, event.robot) or standing:
                continue
            if not state.is_shut(cell):
                self._shut(cell)
                state.sensed.add(cell)

    def take_gone(self, event: ObstacleGone) -> None:
        """Free those of the cells that sensors found blocked."""
        for cell in event.cells:
            if cell in self._state.sensed:
                self._open(cell)

    def take_robot(self, cell: int) -> None:
        """Free a cell that sensors found blocked and that a robot is in: they saw that robot."""
        if cell in self._state.sensed:
            self._open(cell)

    # Requests

    def block_cell(self, event: CellBlocked) -> Reply:
        """Block a cell; a robot that is in it leaves it first."""
        cell = event.cell
        refusal = refuse_block(self._state, cell)
        if refusal:
            return Reply(False, refusal)
        self._shut(cell)
        self._state.sensed.discard(cell)  # Sensors do not free what a person blocked.
        owner = self._state.ledger.owner(cell)
        if owner is None:
            return Reply(True, f"cell {cell} is blocked")
        return Reply(True, f"cell {cell} will be blocked when {owner} has left it")

    def free_cell(self, event: CellFreed) -> Reply:
        """Free a cell, regardless of who blocked it."""
        cell = event.cell
        refusal = refuse_block(self._state, cell)
        if refusal:
            return Reply(False, refusal)
        if cell not in self._state.blocked and cell not in self._state.pending:
            return Reply(True, f"cell {cell} is not blocked")
        self._open(cell)
        return Reply(True, f"cell {cell} is free")

    # Both

    def _shut(self, cell: int) -> None:
        """Block a cell once no robot claims it; stop robots whose paths lead through it."""
        state = self._state
        if state.is_shut(cell):
            return
        state.want_blocked(cell)
        self._dispatcher.left.add(cell)
        self._dispatcher.outdated = True
        for robot in sorted(state.ledger.visitors(cell)):
            record = state.robots[robot]
            if record.phase is Phase.ACTIVE and cell in state.ledger.route(robot)[1:]:
                record.replans += 1
                self._dispatcher.hold(record, f"cell {cell} on its path is blocked")

    def _open(self, cell: int) -> None:
        """Let robots enter a cell again."""
        was_blocked = cell in self._state.blocked
        self._state.free(cell)
        self._dispatcher.to_settle |= self._state.index.hindered_at([cell])
        if was_blocked:
            self._dispatcher.out.append(BlockedChanged(tuple(sorted(self._state.blocked))))
        self._dispatcher.outdated = True
