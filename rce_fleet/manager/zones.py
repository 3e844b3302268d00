"""Zones of the API as the planner's messages have them, and back. Pure.

| kind | value |
|---|---|
| ``blocked`` | none |
| ``slow`` | metres per second |
| ``one_way`` | radians from the grid's columns: 0, pi/2, pi, -pi/2 |
| ``limited`` | number of robots |
| ``cost`` | how much a metre counts |
"""

from __future__ import annotations

from dataclasses import replace
from math import isfinite, pi, tau
from typing import TYPE_CHECKING, Any

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.limits import MOST_LIFETIME, MOST_REASON, MOST_TIME, within
from rce_fleet.tasks.clamping import ZONE_VALUES
from rce_fleet.tasks.records import Zone

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.planning.grid import GridMap

_DIRECTIONS = ("+x", "+y", "-x", "-y")
_NEAR = 0.1
"""Radians that a direction may differ from one of the grid's four."""


def rule(zone: Zone) -> Zone:
    """Return what two copies of a zone must have in common: not its reason, author, end and revision."""
    return replace(
        zone, reason="", user="", until=None, revision=0, unsent=False, cells=tuple(sorted(zone.cells))
    )


def checked(zone: Zone, grid: GridMap | None, now: float) -> Zone:
    """Return a zone as it is kept.

    Args:
        zone: As it was asked for.
        grid: The map; None: not known yet.
        now: Seconds since 1970.

    Raises:
        TaskRefusedError: It cannot be on the map, or its rule is not clear.
    """
    for problem in _problems(zone, grid, now):
        raise TaskRefusedError(f"zone {zone.id!r}: {problem}")
    value = zone.value
    if zone.kind == "one_way" and value is not None:
        value = _quarters(value) * pi / 2
    elif zone.kind == "blocked":
        value = None
    return replace(
        zone,
        value=value,
        cells=tuple(sorted(set(zone.cells))),
        edges=tuple(sorted(set(zone.edges))),
        robots=tuple(sorted(set(zone.robots))),
    )


def zone_fields(zone: Zone, now: float) -> dict[str, Any]:
    """Return the fields of a ``fleet/Zone``.

    Args:
        zone: The zone.
        now: Seconds since 1970.
    """
    value = zone.value or 0.0
    return {
        "id": zone.id,
        "kind": zone.kind,
        "cells": list(zone.cells),
        "edges": [cell for edge in zone.edges for cell in edge],
        "robots": list(zone.robots),
        "speed": value if zone.kind == "slow" else 0.0,
        "direction": _DIRECTIONS[_quarters(value) % 4] if zone.kind == "one_way" else "",
        "capacity": int(value) if zone.kind == "limited" else 0,
        "cost": value if zone.kind == "cost" else 0.0,
        "reason": zone.reason,
        "by": zone.user,
        "lifetime": 0.0 if zone.until is None else within(zone.until - now, 0.001, MOST_LIFETIME),
    }


def read_zone(message: dict[str, Any], now: float) -> Zone:
    """Return the zone of a ``fleet/Zone`` in its JSON form.

    Args:
        message: The message.
        now: Seconds since 1970.
    """
    kind = message["kind"]
    value = None
    if kind == "slow":
        value = within(float(message["speed"]), *ZONE_VALUES[kind])
    elif kind == "limited":
        value = within(float(message["capacity"]), *ZONE_VALUES[kind])
    elif kind == "cost":
        value = within(float(message["cost"]), *ZONE_VALUES[kind])
    elif kind == "one_way":
        value = _quarters(_DIRECTIONS.index(message["direction"]) * pi / 2) * pi / 2
    edges = message["edges"]
    return Zone(
        id=message["id"],
        kind=kind,
        cells=tuple(sorted(message["cells"])),
        value=value,
        edges=tuple(sorted(zip(edges[::2], edges[1::2], strict=True))),
        robots=tuple(sorted(message["robots"])),
        reason=message["reason"][:MOST_REASON],
        user=message["by"],
        until=min(now + message["lifetime"], MOST_TIME) if message["lifetime"] else None,
    )


def _problems(zone: Zone, grid: GridMap | None, now: float) -> Iterator[str]:
    value = zone.value
    if zone.until is not None and zone.until <= now:
        yield f"it ends at {zone.until:.0f}, which is not after now ({now:.0f}), seconds since 1970"
    if not zone.cells and not zone.edges:
        yield "it has no cells"
    if zone.edges and zone.kind != "blocked":
        yield "edges are moves that a blocked zone does not allow"
    if value is None and zone.kind != "blocked":
        yield f"the kind {zone.kind} needs a value"
    if value is not None:
        yield from _problems_of_value(zone.kind, value)
    if grid is not None:
        cells = {*zone.cells, *(cell for edge in zone.edges for cell in edge)}
        outside = sorted(cell for cell in cells if cell not in grid)
        if outside:
            yield f"cell {outside[0]} is not on the map of {len(grid)} cells"
        far = [edge for edge in zone.edges if not outside and not grid.adjacent(*edge)]
        if far:
            yield f"the cells of edge {list(far[0])} are not neighbours"


def _problems_of_value(kind: str, value: float) -> Iterator[str]:
    if not isfinite(value):
        yield "its value must be a number"
    elif kind == "slow" and within(value, *ZONE_VALUES[kind]) != value:
        yield f"a slow zone needs a speed of {_range(kind)} m/s, not {value:g}"
    elif kind == "limited" and (within(value, *ZONE_VALUES[kind]) != value or value != int(value)):
        yield f"limited is a whole number of robots within {_range(kind)}, not {value:g}"
    elif kind == "cost" and within(value, *ZONE_VALUES[kind]) != value:
        yield f"in a cost zone a metre counts {_range(kind)}, not {value:g}"
    elif kind == "one_way" and abs(value / (pi / 2) - round(value / (pi / 2))) > _NEAR / (pi / 2):
        yield f"a direction is 0, pi/2, pi or -pi/2 radians from the grid's columns, not {value:g}"


def _range(kind: str) -> str:
    least, most = ZONE_VALUES[kind]
    return f"{least:.7g} .. {most:.7g}"


def _quarters(radians: float) -> int:
    """Return a direction as quarters of a turn, -1 .. 2."""
    turns = round((radians % tau) / (pi / 2)) % 4
    return turns - 4 if turns == 3 else turns  # noqa: PLR2004 - three quarters are minus one
