"""A fleet gets another grid of cells: when that is safe, and what is kept. Pure.

Cells are numbers, so every list of cells that is under way belongs to one grid. The planner changes its grid
only while all robots stand and have acknowledged their last list. It then begins anew, as after a restart:
it knows where robots stand and which places are blocked, and has no goals.
"""

from __future__ import annotations

from math import ceil, isnan
from typing import TYPE_CHECKING

from rce_fleet.coordination.events import Instruction, PoseSeen, RobotsExpected
from rce_fleet.coordination.move_client import ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.robot import Phase, RobotRecord
from rce_fleet.coordination.zones import ZoneKind, carried_zones

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rce_fleet.coordination.cell_blocks import CellBlock
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings
    from rce_fleet.planning.grid import GridMap

_AT_REST = (ClientState.IDLE, ClientState.FAILED)
_INSET = 1e-6
"""Cells that only share an edge do not overlap: the edge of a cell is left out, as a share of its size."""


def refuse_grid(planner: FleetPlanner, grid: GridMap) -> str:
    """Return why the fleet cannot change to a grid now; empty if it can."""
    least = 2 * (planner.settings.robot_radius + planner.settings.arrival_tolerance)
    if grid.cell_size < least - 1e-9:
        radius = planner.settings.robot_radius
        return (
            f"cells of {grid.cell_size:g} m are too small for robots with a radius of {radius:g} m: choose at"
            f" least {least:.2f} m"
        )
    state = planner.state
    shut = grid.blocked | carried_cells(state.grid, grid, state.blocked | state.pending)
    holders: dict[int, str] = {}
    for robot in sorted(state.robots):
        record = state.robots[robot]
        reason = (
            _under_way(state, record, planner.settings)
            or _unheard(state, record)
            or _misplaced(state, record, planner.settings, grid, shut, holders)
        )
        if reason:
            return reason
    return ""


def next_planner(planner: FleetPlanner, grid: GridMap, now: float) -> tuple[FleetPlanner, list[Instruction]]:
    """Return the planner of another grid, and the instructions with which it begins.

    Its lists of cells have higher numbers than those before, so that move clients take them for newer.

    Args:
        planner: The planner until now, which :func:`refuse_grid` accepts the grid for.
        grid: The new grid.
        now: Time, seconds.
    """
    old = planner.state
    newest = max((record.revision for record in old.robots.values()), default=0)
    made = FleetPlanner(grid, planner.settings, first_revision=newest)
    by_people = _carried_blocks(old.grid, grid, old.requested)
    zones = carried_zones(old.zones.zones.values(), lambda cells: carried_cells(old.grid, grid, cells))
    made.state.zones.put(zones)
    made.state.zones.set_own_costs(old.zones.own_costs)
    made.state.mode, made.state.mode_reason = old.mode, old.mode_reason
    by_zones = {
        cell for zone in zones if zone.kind is ZoneKind.BLOCKED and not zone.robots for cell in zone.cells
    }
    blocks = _carried_blocks(old.grid, grid, old.sensed) | by_people
    for cell in sorted(blocks.keys() | by_zones):
        if cell not in grid.blocked:
            made.state.block(cell)
            if cell in blocks:
                made.state.put_block(cell, blocks[cell])
    instructions = made.handle(RobotsExpected(dict.fromkeys(planner.expected, ())), now)
    for record in old.robots.values():
        if not isnan(record.x):
            instructions += made.handle(PoseSeen(record.id, record.x, record.y, record.yaw), now)
        if record.id in made.state.robots:
            kept = made.state.robots[record.id]
            kept.mode, kept.mode_reason = record.mode, record.mode_reason
            kept.lost = record.lost
    return made, instructions


def carried_cells(old: GridMap, new: GridMap, cells: Iterable[int]) -> set[int]:
    """Return the cells of a new grid that overlap cells of an old one."""
    points = 4 * ceil(old.cell_size / new.cell_size) + 5
    inside = [-0.5 + _INSET + (1 - 2 * _INSET) * index / (points - 1) for index in range(points)]
    found = set()
    for cell in cells:
        row, column = old.place(cell)
        for up in inside:
            for along in inside:
                at = new.cell_at(*old.point(row + 0.5 + up, column + 0.5 + along))
                if at is not None:
                    found.add(at)
    return found


def _carried_blocks(old: GridMap, new: GridMap, blocks: Mapping[int, CellBlock]) -> dict[int, CellBlock]:
    """Return who blocked cells of a new grid; where a cell overlaps several, the block that ends last."""
    found: dict[int, CellBlock] = {}
    for cell, block in sorted(blocks.items()):
        for other in carried_cells(old, new, (cell,)):
            if other not in found or found[other].expires < block.expires:
                found[other] = block
    return found


def _under_way(state: FleetState, record: RobotRecord, settings: FleetSettings) -> str:
    """Return why a robot may be moving; empty if it stands."""
    robot, report = record.id, record.report
    if record.phase is Phase.SILENT:
        return f"{robot} is silent and may be moving: wait for it, or remove it"
    if record.phase is Phase.HOLDING:
        waits = not state.ledger.length(robot) and (isnan(record.x) or record.stands(settings))
        return "" if waits else f"{robot} is stopping: try again when it stands"
    if record.phase is Phase.STANDING:
        return ""
    if len(state.ledger.granted(robot)) > 1 or not record.centred:
        return f"{robot} is driving: remove its goal, or try again when it has arrived"
    has_finished = report is not None and report.revision == record.revision and report.state in _AT_REST
    if not has_finished and not record.pose_only:
        return f"the move client of {robot} has not finished its last list of cells: try again in a second"
    return ""


def _unheard(state: FleetState, record: RobotRecord) -> str:
    """Return why a robot may be in cells that it was granted before; empty if its place is known."""
    if record.pose_only and record.earlier:
        return f"{record.id} may be driving: no pose shows that it stopped; localize it twice, or remove it"
    if isnan(record.x) and state.ledger.claims(record.id):
        return f"{record.id} may be driving and has sent no pose yet: wait for it, or remove it"
    return ""


def _misplaced(
    state: FleetState,
    record: RobotRecord,
    settings: FleetSettings,
    grid: GridMap,
    shut: set[int] | frozenset[int],
    holders: dict[int, str],
) -> str:
    """Return why a robot would have no cell of its own; note the cells that it would have."""
    if not state.ledger.length(record.id):
        return ""  # It has none now either.
    touched = grid.cells_touched(record.x, record.y, settings.robot_radius + settings.clearance)
    cell = grid.cell_at(record.x, record.y)
    if cell is None:
        return f"{record.id} would stand outside of the grid: choose another origin"
    if cell in shut:
        return f"{record.id} would stand in cell {cell}, which would be blocked"
    for taken in sorted(touched):
        other = holders.setdefault(taken, record.id)
        if other != record.id:
            return f"{other} and {record.id} would both be in cell {taken}: choose other cells"
    return ""
