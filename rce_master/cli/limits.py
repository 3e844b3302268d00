"""``rce user show`` and ``rce user limit``: what a user may have."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from rce.protocol.quantities import write_memory
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run

if TYPE_CHECKING:
    from collections.abc import Mapping

_SOURCES = {
    "user": "set for this user",
    "all": "as for all users",
    "machines": "a share of what the machines have",
}
_BYTES = ("memory", "disk")
_DEFAULT = "A number; 0: no limit; default: as for all users."


def show(name: Annotated[str, typer.Argument(help="Default: yourself.")] = "") -> None:
    """Show a user, what they may have and what they have."""
    run(_show(name))


async def _show(name: str) -> None:
    login = credentials.load()
    async with ApiClient.of(login) as client:
        user = await client.call("GET", f"/users/{name or login.user}")
    typer.echo(
        f"{user['name']}: {user['role']} since {time.strftime('%Y-%m-%d', time.localtime(user['created']))}"
    )
    Console().print(_table(user["limits"]))


def _table(limits: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table("what", "used", "limit", "", box=None)
    for kind, limit in limits.items():
        most = _amount(kind, limit["limit"]) if limit["limit"] else "none"
        table.add_row(kind, _amount(kind, limit["used"]), most, _SOURCES[limit["source"]])
    return table


def _amount(kind: str, value: float) -> str:
    return write_memory(round(value)) if kind in _BYTES else f"{value:g}"


def limit(
    name: str,
    containers: Annotated[str | None, typer.Option(help=_DEFAULT)] = None,
    slots: Annotated[str | None, typer.Option(help="Of all containers, as `size` counts them.")] = None,
    cpu: Annotated[str | None, typer.Option(help="Cores that all containers may ask for.")] = None,
    memory: Annotated[str | None, typer.Option(help="Memory that they may ask for, such as 8G.")] = None,
    packages: Annotated[str | None, typer.Option(help="Versions of packages.")] = None,
    disk: Annotated[str | None, typer.Option(help="Files of all packages, such as 2G.")] = None,
) -> None:
    """Change what a user may have. What is there already stays."""
    given = {
        "containers": containers,
        "slots": slots,
        "cpu": cpu,
        "memory": memory,
        "packages": packages,
        "disk": disk,
    }
    chosen = {kind: value for kind, value in given.items() if value is not None}
    if not chosen:
        raise typer.BadParameter("say what to change, such as --slots 16; see: rce user limit --help")
    run(_limit(name, chosen))


async def _limit(name: str, limits: dict[str, str]) -> None:
    async with ApiClient.of(credentials.load()) as client:
        user = await client.call("PATCH", f"/users/{name}/limits", limits)
    Console().print(_table(user["limits"]))
