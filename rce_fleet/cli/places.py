"""``rce fleet place``: chargers, parking places, and return cells, where loads of cancelled tasks go."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from rce_fleet.api.fleet import ChargersModel, ChargersState
from rce_fleet.cli.access import STATION, AsJson, Station, checked, do, echo_json, echo_table
from rce_master.cli.exceptions import CliError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.client import FleetClient

app = typer.Typer(no_args_is_help=True, help="List, add and remove chargers and other places.")


class Kind(StrEnum):
    """What a cell is for."""

    CHARGER = "charger"
    PARKING = "parking"
    RETURN = "return"


_FIELDS = {Kind.CHARGER: "chargers", Kind.PARKING: "parking", Kind.RETURN: "returns"}
"""Their fields in the API."""

Cells = Annotated[list[int], typer.Argument(metavar="CELL...", help="Numbers of the cells.")]
KindOption = Annotated[Kind, typer.Option("--kind", help="What they are.")]


@app.command("list")
def list_(json_: AsJson = False, station: Station = STATION) -> None:
    """List chargers, parking places and return cells."""

    async def work(client: FleetClient) -> None:
        found = await client.chargers()
        if json_:
            echo_json(found)
            return
        users = {cell: robot for robot, cell in found.charging.items()}
        rows = [
            (str(cell), kind.value, users.get(cell, "-") if kind is Kind.CHARGER else "-")
            for kind in Kind
            for cell in _cells(found, kind)
        ]
        echo_table(("cell", "kind", "robot"), rows)
        if found.waiting:
            typer.echo(f"waiting for a charger: {' '.join(found.waiting)}")

    do(station, work)


@app.command("add")
def add(cells: Cells, kind: KindOption = Kind.CHARGER, station: Station = STATION) -> None:
    """Add chargers, parking places or return cells."""
    _change(station, kind, lambda known: [*known, *(cell for cell in cells if cell not in known)])


@app.command("remove")
def remove(cells: Cells, kind: KindOption = Kind.CHARGER, station: Station = STATION) -> None:
    """Remove chargers, parking places or return cells."""

    def without(known: list[int]) -> list[int]:
        if missing := [str(cell) for cell in cells if cell not in known]:
            raise CliError(
                f"expected cells of the kind {kind}, found {', '.join(missing)}; see rce fleet place list"
            )
        return [cell for cell in known if cell not in cells]

    _change(station, kind, without)


def _cells(places: ChargersModel, kind: Kind) -> list[int]:
    found: list[int] = getattr(places, _FIELDS[kind])
    return found


def _change(station: str, kind: Kind, change: Callable[[list[int]], list[int]]) -> None:
    """Change the cells of a kind; refused if another user changes places meanwhile."""

    async def work(client: FleetClient) -> None:
        found = await client.chargers()
        fields = {field: _cells(found, each) for each, field in _FIELDS.items()}
        fields[_FIELDS[kind]] = change(_cells(found, kind))
        with checked():
            places = ChargersModel.model_validate(fields)
        made: ChargersState = await client.set_chargers(places, revision=found.revision)
        typer.echo(f"{kind}: {' '.join(map(str, _cells(made, kind))) or 'none'}")

    do(station, work)
