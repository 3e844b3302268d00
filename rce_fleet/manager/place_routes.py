"""The routes of chargers, parking places, return cells, zones and blocked cells."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, cast

from rce_fleet.api.fleet import (
    CellAnswer,
    CellChange,
    ChargersModel,
    ChargersState,
    ZoneList,
    ZoneModel,
    ZoneRequest,
)
from rce_fleet.exceptions import TaskRefusedError, UnknownTaskError
from rce_fleet.limits import MOST_CELL, MOST_ZONES
from rce_fleet.manager.cell_blocks import describe_block
from rce_fleet.manager.goals import NO_ANSWER
from rce_fleet.manager.planner_sync import BlockCell
from rce_fleet.manager.requests import Call, FleetAnswer, Route, problem, shown
from rce_fleet.manager.zones import checked
from rce_fleet.tasks.records import NOT_KNOWN, CellBlock, Places, Zone

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.api.fleet import ZoneKindName

MOST_DIGITS = 10
"""Digits of a cell's number."""


async def chargers(call: Call) -> FleetAnswer:
    """Return chargers, parking places and return cells, and who charges."""
    places, queue = call.manager.book.places, call.manager.dispatcher.chargers
    return shown(
        ChargersState(
            chargers=list(places.chargers),
            parking=list(places.parking),
            returns=list(places.returns),
            charging=dict(queue.charging),
            waiting=list(queue.waiting),
            revision=places.revision,
        ),
        revision=places.revision,
    )


async def set_chargers(call: Call) -> FleetAnswer:
    """Replace chargers, parking places and return cells."""
    model = call.model(ChargersModel)
    book = call.manager.book
    call.check_revision("the chargers", book.places.revision)
    check_cells(call, (*model.chargers, *model.parking, *model.returns))
    places = Places(
        tuple(dict.fromkeys(model.chargers)),
        tuple(dict.fromkeys(model.parking)),
        tuple(dict.fromkeys(model.returns)),
        book.places.revision + 1,
    )
    text = f"{len(places.chargers)} chargers, {len(places.parking)} parking places"
    book.emit(places, "places", call.now, user=call.request.user, text=text)
    await call.manager.commit()
    return await chargers(call)


def check_cells(call: Call, cells: Iterable[int]) -> None:
    """Check that robots can be in these cells.

    Raises:
        TaskRefusedError: One is a wall, or not on the map.
    """
    grid = call.manager.book.grid
    for cell in cells:
        if grid is not None and (cell not in grid or cell in grid.blocked):
            what = "a wall" if cell in grid else f"not on the map of {len(grid)} cells"
            raise TaskRefusedError(f"cell {cell} is {what}")


async def zones(call: Call) -> FleetAnswer:
    """Return zones by name: all, or a page of them; of some kinds only."""
    call.only("limit", "cursor", "kind")
    limit, after = call.count("limit", 0, MOST_ZONES), call.query.get("cursor", "")
    kinds = call.query.get("kind", "").split(",")
    found = sorted(call.manager.book.zones.values(), key=lambda zone: zone.id)
    fitting = (zone for zone in found if zone.id > after and (kinds == [""] or zone.kind in kinds))
    page = list(islice(fitting, limit or None))
    more = next(fitting, None) is not None
    return shown(ZoneList(zones=[_show_zone(zone) for zone in page], next=page[-1].id if more else None))


async def zone(call: Call) -> FleetAnswer:
    """Return a zone."""
    found = _zone(call)
    return shown(_show_zone(found), revision=found.revision)


async def set_zone(call: Call) -> FleetAnswer:
    """Make or replace a zone; if the planner refuses, the zones stay as they were."""
    async with call.manager.changes.hold("zone", call.names[0]):
        return await _set_zone(call)


async def _set_zone(call: Call) -> FleetAnswer:
    model, name = call.model(ZoneRequest), call.names[0]
    book, now = call.manager.book, call.manager.clock()
    known = book.zones.get(name)
    call.check_revision(f"zone {name}", known.revision if known else 0)
    asked = Zone(
        name,
        model.kind,
        tuple(model.cells),
        model.value,
        tuple((edge[0], edge[1]) for edge in model.edges),
        tuple(model.robots),
        model.reason,
        call.request.user,
        model.until,
        book.next_revision(known),
        unsent=True,
    )
    made = checked(asked, book.grid, now)
    book.emit(made, "zone", now, user=call.request.user, text=f"zone {name}: {model.kind}")
    await call.manager.commit()
    if refusal := await call.manager.set_zone(made, known):
        raise TaskRefusedError(refusal)
    return shown(_show_zone(made), 200 if known else 201, made.revision)


async def remove_zone(call: Call) -> FleetAnswer:
    """Remove a zone."""
    found = _zone(call)
    call.check_revision(f"zone {found.id}", found.revision)
    gone = replace(found, is_removed=True, revision=found.revision + 1, unsent=True)
    call.manager.book.emit(
        gone, "zone removed", call.now, user=call.request.user, text=f"zone {found.id} is gone"
    )
    await call.manager.commit()
    await call.manager.tell_planner()
    return shown(_show_zone(found), revision=gone.revision)


async def set_cell(call: Call) -> FleetAnswer:
    """Block or free a cell; if the planner refuses, it stays as it was."""
    name, asked = call.names[0], call.model(CellChange)
    if not (name.isdecimal() and name.isascii() and len(name) <= MOST_DIGITS):
        return problem(404, f"{name[:MOST_DIGITS]!r} is not the number of a cell")
    cell = int(name)
    if cell > MOST_CELL:
        return problem(404, f"cells have numbers up to {MOST_CELL}, not {cell}")
    check_cells(call, (cell,))
    async with call.manager.changes.hold("cell", str(cell)):
        return await _set_cell(call, cell, asked)


async def _set_cell(call: Call, cell: int, asked: CellChange) -> FleetAnswer:
    manager, user, now = call.manager, call.request.user, call.manager.clock()
    before, blocked = manager.book.blocked, asked.blocked
    if blocked and asked.until is not None and asked.until <= now:
        raise TaskRefusedError(f"cell {cell}: the end {asked.until:.0f} is not after now ({now:.0f})")
    was_blocked, block = cell in before.cells, before.block(cell)
    is_other = (block.reason, block.until) != (asked.reason, asked.until)
    is_new = was_blocked != blocked or (blocked and is_other)
    text = f"cell {cell} is {'blocked' if blocked else 'free'}"
    if is_new:
        block = CellBlock(user, asked.reason, now, asked.until) if blocked else NOT_KNOWN
        made = before.changed({cell: blocked}, unsent=True, blocks={cell: block})
        told = describe_block(cell, block) if blocked else text
        manager.book.emit(made, "blocked" if blocked else "freed", now, user=user, text=told)
    await manager.commit()  # also if it is so already: that may not be in the journal yet
    # A cell that only sensors found blocked is freed as well, though the journal does not have it.
    if refusal := await manager.tell(BlockCell(cell, blocked, block)):
        after = manager.book.blocked
        if is_new and (cell in after.cells, after.block(cell)) == (blocked, block):
            kept = {cell: before.blocks[cell]} if cell in before.blocks else {}
            back = after.changed({cell: was_blocked}, unsent=False, blocks=kept)
            manager.book.emit(back, "refused", manager.clock(), text=f"cell {cell}: {refusal}")
            await manager.commit()
        if refusal.startswith(NO_ANSWER):
            return problem(503, refusal)
        raise TaskRefusedError(refusal)
    inside = [robot.id for robot in manager.facts.robots.values() if robot.cell == cell and robot.is_there]
    if blocked and inside:
        text = f"cell {cell} will be blocked when {inside[0]} has left it"
    return shown(CellAnswer(message=text))


def _zone(call: Call) -> Zone:
    found = call.manager.book.zones.get(call.names[0])
    if found is None:
        raise UnknownTaskError(f"there is no zone {call.names[0]!r}")
    return found


def _show_zone(zone: Zone) -> ZoneModel:
    return ZoneModel(
        id=zone.id,
        kind=cast("ZoneKindName", zone.kind),
        cells=list(zone.cells),
        value=zone.value,
        edges=[list(edge) for edge in zone.edges],
        robots=list(zone.robots),
        reason=zone.reason,
        until=zone.until,
        user=zone.user,
        revision=zone.revision,
    )


ROUTES = [
    Route("GET", "/chargers", chargers),
    Route("PUT", "/chargers", set_chargers, changes=True),
    Route("GET", "/zones", zones),
    Route("GET", "/zones/{id}", zone),
    Route("PUT", "/zones/{id}", set_zone, changes=True),
    Route("DELETE", "/zones/{id}", remove_zone, changes=True),
    Route("PUT", "/cells/{cell}", set_cell, changes=True),
]
