"""``rce fleet zone``: cells with a rule, which may have a reason, an end and robots that they are for."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from rce_fleet.api.fleet import ZoneModel, ZoneRequest
from rce_fleet.cli.access import STATION, AsJson, Station, checked, do, echo_json, echo_table

if TYPE_CHECKING:
    from rce_fleet.client import FleetClient

app = typer.Typer(no_args_is_help=True, help="List, add and remove zones.")

Name = Annotated[str, typer.Argument(metavar="ZONE", help="Its name.")]


@app.command("list")
def list_(json_: AsJson = False, station: Station = STATION) -> None:
    """List zones."""

    async def work(client: FleetClient) -> None:
        found = await client.zones()
        if json_:
            echo_json(found)
            return
        header = ("zone", "rule", "value", "cells", "robots", "until", "by", "reason")
        echo_table(header, [_row(zone) for zone in found])

    do(station, work)


def _row(zone: ZoneModel) -> tuple[str, ...]:
    value = "-" if zone.value is None else f"{zone.value:g}"
    ends = "-"
    if zone.until is not None:
        ends = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(zone.until))
    places = [*map(str, zone.cells), *(f"{start}>{end}" for start, end in zone.edges)]
    robots = " ".join(zone.robots) or "all"
    return (zone.id, zone.kind, value, " ".join(places), robots, ends, zone.user, zone.reason)


@app.command("add")
def add(
    name: Name,
    cells: Annotated[
        list[int] | None, typer.Argument(metavar="CELL...", help="Numbers of its cells.")
    ] = None,
    kind: Annotated[str, typer.Option(help="blocked, slow, one_way, limited or cost.")] = "blocked",
    value: Annotated[
        float | None, typer.Option(help="Metres per second, radians, number of robots, or a factor.")
    ] = None,
    edge: Annotated[
        list[str] | None,
        typer.Option(help="A move that a blocked zone does not allow, such as 12>13; may be repeated."),
    ] = None,
    robot: Annotated[
        list[str] | None, typer.Option(help="A robot that it is for (default: all); may be repeated.")
    ] = None,
    reason: Annotated[str, typer.Option(help="For people.")] = "",
    lasts: Annotated[float, typer.Option("--for", help="Seconds until it ends; 0: it stays.", min=0.0)] = 0.0,
    station: Station = STATION,
) -> None:
    """Make or replace a zone."""
    with checked():
        zone = ZoneRequest.model_validate(
            {
                "kind": kind,
                "cells": cells or [],
                "value": value,
                "edges": [_edge(text) for text in edge or ()],
                "robots": robot or [],
                "reason": reason,
                "until": time.time() + lasts if lasts else None,
            }
        )

    async def work(client: FleetClient) -> None:
        made = await client.set_zone(name, zone)
        typer.echo(f"zone {made.id}: {made.kind}, {len(made.cells)} cells, {len(made.edges)} moves")

    do(station, work)


def _edge(text: str) -> list[int]:
    """Return the cells of a move that is written as ``12>13``."""
    start, _, end = text.partition(">")
    if not (start.isdecimal() and end.isdecimal()):
        raise typer.BadParameter(f"a move is written as 12>13, not {text!r}", param_hint="--edge")
    return [int(start), int(end)]


@app.command("remove")
def remove(name: Name, station: Station = STATION) -> None:
    """Remove a zone."""

    async def work(client: FleetClient) -> None:
        await client.remove_zone(name)
        typer.echo(f"zone {name} is removed")

    do(station, work)
