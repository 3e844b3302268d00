"""``rce user show`` and ``rce user limit``: what a user may have."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from rce.model import about
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import CliError
from rce_master.cli.offline import StateDir, choose, open_state
from rce_master.cli.tables import TextTable
from rce_master.exceptions import NotFoundError
from rce_master.limit_values import read_limit
from rce_master.state.commands import SetLimits
from rce_master.state.limits import KINDS, limit_of, used_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_master.state.core import State

_SOURCES = {
    "user": "set for this user",
    "role": "administrators have none unless it is set",
    "all": "as for all users",
    "machines": "a share of what the machines have",
}
_BYTES = ("memory", "disk")
_DEFAULT = "A number; 0: no limit; default: what users of this role have."


def show(
    name: Annotated[str, typer.Argument(help="Default: yourself.")] = "", state_dir: StateDir = None
) -> None:
    """Show a user, what they may have and what they have."""
    run(_show(name, state_dir))


async def _show(name: str, state_dir: Path | None) -> None:
    place = choose(state_dir)
    if not isinstance(place, Path):
        async with ApiClient.of(place) as client:
            user = await client.call("GET", f"/users/{name or place.user}")
    elif not name:
        raise CliError("say whom to show, or log in first (rce login)")
    else:
        async with open_state(place) as offline:
            user = _view(offline.state, name)
    typer.echo(
        f"{user['name']}: {user['role']} since {time.strftime('%Y-%m-%d', time.localtime(user['created']))}"
    )
    Console().print(_table(user["limits"]))


def _table(limits: Mapping[str, Mapping[str, Any]]) -> TextTable:
    table = TextTable("what", "used", "limit", "")
    for kind, limit in limits.items():
        most = _amount(kind, limit["limit"]) if limit["limit"] else "none"
        source = limit["source"]
        table.add(kind, _amount(kind, limit["used"]), most, _SOURCES.get(source, source))
    return table


def _amount(kind: str, value: float) -> str:
    return about(value) if kind in _BYTES else f"{value:g}"


def limit(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    containers: Annotated[str | None, typer.Option(help=_DEFAULT)] = None,
    slots: Annotated[str | None, typer.Option(help="Of all containers, as `size` counts them.")] = None,
    cpu: Annotated[str | None, typer.Option(help="Cores that all containers may ask for.")] = None,
    memory: Annotated[str | None, typer.Option(help="Memory that they may ask for, such as 8G.")] = None,
    packages: Annotated[str | None, typer.Option(help="Versions of packages.")] = None,
    disk: Annotated[str | None, typer.Option(help="Of packages and volumes, such as 2G.")] = None,
    state_dir: StateDir = None,
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
    run(_limit(name, chosen, state_dir))


async def _limit(name: str, limits: dict[str, str], state_dir: Path | None) -> None:
    place = choose(state_dir)
    if not isinstance(place, Path):
        async with ApiClient.of(place) as client:
            user = await client.call("PATCH", f"/users/{name}/limits", limits)
    else:
        command = SetLimits(user=name, limits={kind: read_limit(kind, limits[kind]) for kind in limits})
        async with open_state(place) as offline:
            await offline.do(command, "set_limits", name)
            user = _view(offline.state, name)
    Console().print(_table(user["limits"]))


def _view(state: State, name: str) -> dict[str, Any]:
    """Show a user of a state as the API does."""
    user = state.tables.users.get(name)
    if user is None:
        raise NotFoundError(f"there is no user {name!r}")
    used = used_of(state.tables, name)
    found = (limit_of(state.tables, state.settings, name, kind) for kind in KINDS)
    limits = {one.kind: {"limit": one.most, "used": used[one.kind], "source": one.source} for one in found}
    return {"name": user.name, "role": user.role.value, "created": user.created, "limits": limits}
