"""``rce volume``: the folders of users that outlive containers."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer
from rich.console import Console

from rce.model import about
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, OfUser, OfUserByAdmin, of_user, run
from rce_master.cli.tables import TextTable

app = typer.Typer(no_args_is_help=True, help="List and remove volumes of containers.")


@app.command("list")
def list_(user: OfUser = "") -> None:
    """List volumes with their use and their machine."""
    run(_list(user))


async def _list(user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await client.items("/volumes", query=of_user(user))
    several = len({one["user"] for one in found}) > 1
    table = TextTable("volume", "used", "size", "machine", "container", "path", "snapshot")
    for one in found:
        name = f"{one['user']}/{one['name']}" if several else one["name"]
        used = "-" if one["used"] is None else about(one["used"])
        table.add(name, used, about(one["size"]), *(_or_dash(one, *_PLACE)), _snapshot(one))
    Console().print(table)


_PLACE = ("machine", "container", "path")


def _snapshot(volume: dict[str, Any]) -> str:
    taken = "-"
    if volume["snapshot"] is not None:
        taken = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(volume["snapshot"]))
    return f"{taken}; {volume['fault']}" if volume["fault"] else taken


def _or_dash(one: dict[str, Any], *keys: str) -> list[str]:
    return [one[key] or "-" for key in keys]


@app.command("remove")
def remove(
    name: Annotated[str, typer.Argument(help="Name of the volume.")],
    user: OfUserByAdmin = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Remove a volume and all its files."""
    if not yes:
        typer.confirm(f"Remove volume {name} and all its files?", abort=True)
    run(_remove(name, user))


async def _remove(name: str, user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        await client.call("DELETE", f"/volumes/{name}", query=of_user(user))
    typer.echo(f"removed {name}")
