"""``rce machines``, ``rce drain``, ``rce move``, ``rce resize``: where containers run, who gets how much."""

from __future__ import annotations

import asyncio
import json
from http import HTTPStatus
from typing import Annotated, Any

import typer
from rich.text import Text

from rce.model import about, write_cores
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, of_user, run
from rce_master.cli.exceptions import ApiError, CliError
from rce_master.cli.show import console
from rce_master.cli.tables import TextTable, coloured, plain

POLL_S = 0.5
LOST_POLLS = 60
"""Polls without an answer, while the lead changes, until a command fails."""

Machine = dict[str, Any]


def machines(
    json_: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Show machines and their reserved resources; administrators only."""
    run(_machines(json_))


async def _machines(as_json: bool) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await client.items("/machines")
        masters = [] if as_json else await fetch_masters(client)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    screen = console()
    screen.print(overview(found))
    if masters:
        screen.print(overview_of_masters(masters))
    for machine in found:
        if machine["detail"]:
            screen.print(plain(f"{machine['process']}: {machine['detail']}"))
        _print_staying(machine)


async def fetch_masters(client: ApiClient) -> list[Machine]:
    """Return the masters; a master of the previous release does not know them."""
    try:
        return list((await client.call("GET", "/masters"))["masters"])
    except ApiError as error:
        if error.status != HTTPStatus.NOT_FOUND:
            raise
        return []


def overview_of_masters(found: list[Machine]) -> TextTable:
    """Format several masters as a table."""
    table = TextTable("master", "role", "url")
    for master in found:
        state = coloured(master["role"])
        if master["drained"]:
            state.append(" drained", "yellow")
        table.add(master["name"], state, master["url"])
    return table


def overview(found: list[Machine]) -> TextTable:
    """Format machines as a table."""
    names = ("task set", "machine", "state", "containers", "slots", "cores", "memory")
    table = TextTable(*names, "limits", "runtime", "labels")
    for machine in sorted(found, key=lambda m: (m["kind"], m["machine"], m["process"])):
        if machine["kind"] == "container":
            table.add(
                machine["process"],
                machine["machine"],
                _state(machine),
                str(machine["endpoints"]),
                _of(machine["promised_slots"], machine["slots"]),
                f"{write_cores(machine['promised_cores'])} of {machine['cores']}",
                f"{about(machine['promised_memory'])} of {about(machine['memory'])}",
                machine["limits"],
                machine["runtime"],
                " ".join(machine["labels"]),
            )
        else:
            robots = f"{machine['endpoints']} robots"
            table.add(machine["process"], machine["machine"], _state(machine), robots, *[""] * 6)
    return table


def _of(promised: int, there: int) -> str:
    return f"{promised} of {there}" if there else str(promised)


def _state(machine: Machine) -> Text:
    if not machine["connected"]:
        return coloured("away")
    return coloured("draining" if machine["draining"] else "connected")


def _print_staying(machine: Machine) -> None:
    for item in machine["staying"]:
        typer.echo(f"  {item['container']} is still at {machine['process']}: {item['why']}")


def drain(
    machine: Annotated[str, typer.Argument(help="Name of the machine, one of its task sets, or a master.")],
    undo: Annotated[bool, typer.Option("--undo", help="Let it take containers and robots again.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until all that it has is elsewhere.")] = False,
) -> None:
    """Give a machine no new containers and robots, and hand over those that it has; administrators only.

    Each container is started elsewhere first and then dropped here. Robots are disconnected, and connect to
    another robot task set. What finds no place elsewhere stays, and goes as soon as there is one.

    Of several masters, one that is drained hands the lead over, and leads again only if no other one does.
    """
    run(_undrain(machine) if undo else _drain(machine, wait=wait))


async def _undrain(machine: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        told = await client.call("DELETE", f"/machines/{machine}/drain")
    for master in told.get("masters", ()):
        typer.echo(f"{master['name']} may lead again")
    if not told.get("masters"):
        typer.echo(f"{machine} takes containers and robots again")


async def _drain(machine: str, *, wait: bool) -> None:
    async with ApiClient.of(credentials.load()) as client:
        told = await client.call("PUT", f"/machines/{machine}/drain")
        if masters := told.get("masters"):
            await _drain_master(client, masters[0]["name"], wait=wait)
            return
        found = told["machines"]
        typer.echo(f"{machine} takes no new containers and robots")
        said: dict[str, str] = {}
        while True:
            _tell_changes(found, said)
            if not said or not wait:
                return
            await asyncio.sleep(POLL_S)
            everything = await client.items("/machines")
            found = [one for one in everything if machine in (one["process"], one["machine"])]
            if not any(one["draining"] for one in found):
                raise CliError(f"{machine} is not drained any more")


async def _drain_master(client: ApiClient, name: str, *, wait: bool) -> None:
    typer.echo(f"{name} leads only if no other master does")
    lost = 0
    while True:
        try:
            masters = await fetch_masters(client)
            lost = 0
        except CliError as error:  # while the lead changes
            lost += 1
            if lost >= LOST_POLLS or getattr(error, "status", 503) != HTTPStatus.SERVICE_UNAVAILABLE:
                raise
            masters = []
        leader = next((one["name"] for one in masters if one["role"] == "leader"), "")
        others = any(one["role"] == "standby" and not one["drained"] for one in masters)
        if leader and leader != name:
            typer.echo(f"{leader} leads")
            return
        if not wait and leader and not others:
            typer.echo(f"{name} leads until another master can")
            return
        await asyncio.sleep(POLL_S)


def _tell_changes(found: list[Machine], said: dict[str, str]) -> None:
    staying = {item["container"]: item["why"] for machine in found for item in machine["staying"]}
    for machine in found:
        if machine["kind"] == "robot" and machine["endpoints"]:
            staying[machine["process"]] = "its robots stay until another robot task set takes them"
    for what in [what for what in said if what not in staying]:
        del said[what]
        typer.echo(f"{what}: {'is' if '/' in what else 'its robots are'} elsewhere now")
    for what, why in staying.items():
        if said.get(what) != why:
            typer.echo(f"{what}: {why}")
            said[what] = why
    if not staying:
        typer.echo("it is empty")


def resize(
    container: Annotated[str, typer.Argument(help="The container's tag.")],
    cpu: Annotated[str | None, typer.Option(help="Cores: 0.5 or 50%; 0: no request.")] = None,
    memory: Annotated[str | None, typer.Option(help="256 (MB), 256M, 1G; 0: no request.")] = None,
    size: Annotated[int | None, typer.Option(help="Slots.", min=1)] = None,
    bandwidth: Annotated[
        str | None, typer.Option(help="Of its links: 5M (bytes per second), 10Mbit; 0: no request.")
    ] = None,
    user: Annotated[str, typer.Option(help="Whose container; administrators only.")] = "",
) -> None:
    """Change a container's resources while it runs."""
    requested: dict[str, Any] = {"cpu": cpu, "memory": memory, "size": size, "bandwidth": bandwidth}
    body = {key: value for key, value in requested.items() if value is not None}
    if not body:
        raise typer.BadParameter("give one or more of --cpu, --memory, --size, --bandwidth")
    run(_resize(container, body, user))


async def _resize(container: str, body: dict[str, Any], user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        await client.call("PATCH", f"/containers/{container}", body, of_user(user))
    typer.echo(f"resized {container}: {', '.join(f'{key} {value}' for key, value in body.items())}")


def move(
    container: Annotated[str, typer.Argument(help="The container's tag.")],
    machine: Annotated[str, typer.Argument(help="Name of the machine, or of its container task set.")],
    user: Annotated[str, typer.Option(help="Whose container.")] = "",
    wait: Annotated[bool, typer.Option("--wait", help="Wait until it is there, or stays.")] = False,
) -> None:
    """Hand a container over to another machine while it runs; administrators only.

    It is started there first and then dropped here, with the containers that share a private network with
    it. One with volumes is ended first, and its volumes move with it. All else that it holds is lost, except
    the state of nodes that keep it (`state` in the container's config).
    """
    run(_move(container, machine, user, wait=wait))


async def _move(container: str, machine: str, user: str, *, wait: bool) -> None:
    query = of_user(user)
    async with ApiClient.of(credentials.load()) as client:
        await client.call("PUT", f"/containers/{container}/machine", {"machine": machine}, query)
        typer.echo(f"{container} moves to {machine}")
        while wait:
            found = [one for one in await client.items("/containers", query=query) if one["tag"] == container]
            if not found:
                raise CliError(f"{container} was destroyed")
            if not found[0]["moving_to"]:
                break
            await asyncio.sleep(POLL_S)
        else:
            return
        if machine not in (found[0]["task_set"], found[0]["machine"]):
            raise CliError(f"{container} is still at {found[0]['task_set']}: {found[0]['detail']}")
        typer.echo(f"{container} is there")
