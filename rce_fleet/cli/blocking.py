"""``rce fleet block`` and ``free``: cells, moves and lanes, for all robots or for some, for a time.

A cell that is blocked for all robots until it is freed has no zone. Everything else is a zone that is named
after its place, so that ``free`` finds it: ``block 12``, ``block 12>13 for Robot1``. Zones need a fleet
manager; without one, a cell for all robots gets reason and end itself.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated

import typer

from rce.printable import for_terminal
from rce_fleet.api.fleet import ZoneRequest
from rce_fleet.cli.access import STATION, Station, checked, do
from rce_fleet.cli.times import read_time
from rce_fleet.client import FleetApiUnavailableError
from rce_master.cli.exceptions import CliError

if TYPE_CHECKING:
    from rce_fleet.api.fleet import LaneModel
    from rce_fleet.client import FleetClient

Places = Annotated[
    list[str] | None,
    typer.Argument(metavar="PLACE...", help="Cells, such as 12, or moves, such as 12>13 (in quotes)."),
]
Lanes = Annotated[list[str] | None, typer.Option("--lane", help="A lane, by its name; may be repeated.")]
Robots = Annotated[
    list[str] | None, typer.Option("--robot", help="A robot that it is for (default: all); may be repeated.")
]


@dataclass(frozen=True, slots=True)
class _Place:
    """What is blocked: cells or moves, and its name."""

    name: str
    cells: tuple[int, ...] = ()
    edges: tuple[tuple[int, int], ...] = ()

    def zone(self, robots: list[str]) -> str:
        """Return the name of its zone for these robots."""
        return f"block {self.name}" + (f" for {' '.join(robots)}" if robots else "")

    def has_zone(self, zone: str, robots: list[str]) -> bool:
        """Return whether it has this zone for these robots; without robots, for all or any."""
        is_for_some = zone.startswith(f"{self.zone([])} for ")
        return zone == self.zone(robots) or (is_for_some and not robots)


def block(
    places: Places = None,
    lane: Lanes = None,
    robot: Robots = None,
    reason: Annotated[str, typer.Option(help="For people.")] = "",
    lasts: Annotated[float, typer.Option("--for", help="Seconds until it ends; 0: it stays.", min=0.0)] = 0.0,
    until: Annotated[
        str, typer.Option(help="When it ends, such as 18:30 or 2026-11-28T18:30; local time.")
    ] = "",
    station: Station = STATION,
) -> None:
    """Block cells, moves or lanes, for all robots or some."""
    found, robots = _places(places, lane), sorted(set(robot or ()))
    if lasts and until:
        raise typer.BadParameter("give either --for or --until", param_hint="--until")
    end = time.time() + lasts if lasts else read_time(until, time.time()) if until else None

    async def work(client: FleetClient) -> None:
        for place in [*found, *await _lanes(client, lane)]:
            if place.cells and not (robots or reason or end):
                typer.echo(for_terminal(await client.set_blocked(place.cells[0], blocked=True)))
                continue
            with checked():
                asked = ZoneRequest.model_validate(
                    {
                        "kind": "blocked",
                        "cells": place.cells,
                        "edges": place.edges,
                        "robots": robots,
                        "reason": reason,
                        "until": end,
                    }
                )
            try:
                await client.set_zone(place.zone(robots), asked)
            except FleetApiUnavailableError:
                if robots or not place.cells:
                    raise
                await client.set_blocked(place.cells[0], blocked=True, reason=reason, until=end)
            whom = f" for {', '.join(robots)}" if robots else ""
            when = f" until {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(end))}" if end else ""
            typer.echo(f"{_word(place)} is blocked{whom}{when}")

    do(station, work)


def free(
    places: Places = None,
    lane: Lanes = None,
    robot: Robots = None,
    station: Station = STATION,
) -> None:
    """Free what was blocked; without robots, for all and for each."""
    found, robots = _places(places, lane), sorted(set(robot or ()))
    found += [_Place(f"lane {name}") for name in lane or ()]

    async def work(client: FleetClient) -> None:
        zones = await _zones(client, cells_only=not robots and all(place.cells for place in found))
        missing = []
        for place in found:
            wanted = [zone for zone in zones if place.has_zone(zone, robots)]
            for zone in wanted:
                await client.remove_zone(zone)
            if place.cells and not robots:
                typer.echo(for_terminal(await client.set_blocked(place.cells[0], blocked=False)))
                continue
            whom = f" for {', '.join(robots)}" if robots else ""
            if wanted:
                typer.echo(f"{_word(place)} is free{whom}")
            else:
                missing.append(f"{_word(place)}{whom}")
        if missing:
            raise CliError(
                f"not blocked by rce fleet block: {', '.join(missing)}; rce fleet zone list shows all zones"
            )

    do(station, work)


async def _zones(client: FleetClient, *, cells_only: bool) -> list[str]:
    """Return the names of the zones; none, with a warning, for plain cells without a fleet manager.

    Raises:
        StationError: They cannot be read.
    """
    try:
        return [zone.id for zone in await client.zones()]
    except FleetApiUnavailableError as error:
        if not cells_only:
            raise
        reason = for_terminal(str(error))
        typer.echo(f"rce fleet: zones are left as they are, they cannot be read: {reason}", err=True)
        return []


def _places(texts: list[str] | None, lanes: list[str] | None) -> list[_Place]:
    if not texts and not lanes:
        raise typer.BadParameter("name a cell, such as 12, a move, such as 12>13, or a --lane")
    return [_place(text) for text in texts or ()]


def _place(text: str) -> _Place:
    start, arrow, end = text.partition(">")
    if not start.isdecimal() or (arrow and not end.isdecimal()):
        raise typer.BadParameter(f"expected a cell, such as 12, or a move, such as 12>13, found {text!r}")
    if arrow:
        return _Place(f"{int(start)}>{int(end)}", edges=((int(start), int(end)),))
    return _Place(str(int(start)), cells=(int(start),))


async def _lanes(client: FleetClient, names: list[str] | None) -> list[_Place]:
    """Return the moves of lanes.

    Raises:
        typer.BadParameter: A lane is unknown.
    """
    if not names:
        return []
    lanes = {lane.name: lane for lane in (await client.map()).lanes}
    unknown = [name for name in names if name not in lanes]
    if unknown:
        known = ", ".join(sorted(lanes)) or "none"
        raise typer.BadParameter(f"unknown lane {unknown[0]!r}; lanes are {known}", param_hint="--lane")
    return [_Place(f"lane {name}", edges=_moves(lanes[name])) for name in names]


def _moves(lane: LaneModel) -> tuple[tuple[int, int], ...]:
    there = tuple(pairwise(lane.cells))
    return there if lane.one_way else (*there, *((end, start) for start, end in there))


def _word(place: _Place) -> str:
    if place.cells:
        return f"cell {place.name}"
    return place.name if place.name.startswith("lane ") else f"the move {place.name}"
