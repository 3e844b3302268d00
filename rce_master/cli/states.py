"""``rce state``: the saved states of nodes."""

from __future__ import annotations

import time
from typing import Annotated

import typer
from rich.console import Console

from rce.model import about
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, OfUser, OfUserByAdmin, of_user, run
from rce_master.cli.tables import TextTable

app = typer.Typer(no_args_is_help=True, help="List and remove saved states of nodes.")


@app.command("list")
def list_(user: OfUser = "") -> None:
    """List saved states with their size and age."""
    run(_list(user))


async def _list(user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await client.items("/states", query=of_user(user))
    several = len({one["user"] for one in found}) > 1
    table = TextTable("node", "size", "saved", "at")
    for one in found:
        name = f"{one['container']}/{one['node']}"
        age = f"{max(0.0, time.time() - one['taken']):.0f} s ago"
        table.add(
            f"{one['user']}/{name}" if several else name, about(one["size"]), age, one["machine"] or "-"
        )
    Console().print(table)


@app.command("remove")
def remove(
    node: Annotated[str, typer.Argument(metavar="CONTAINER/NODE", help="Whose state.")],
    user: OfUserByAdmin = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Remove the saved state of a node."""
    container, slash, tag = node.partition("/")
    if not slash or not container or not tag or "/" in tag:
        raise typer.BadParameter(f"{node!r} names no node: write CONTAINER/NODE")
    if not yes:
        typer.confirm(f"Remove the saved state of {node}?", abort=True)
    run(_remove(container, tag, user))


async def _remove(container: str, tag: str, user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        await client.call("DELETE", f"/states/{container}/{tag}", query=of_user(user))
    typer.echo(f"removed the saved state of {container}/{tag}")
