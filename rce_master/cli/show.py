"""``rce ps``: what is there."""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Annotated, Any

import typer
from rich.console import Console, Group

from rce.aio.tasks import errors_in
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import ApiError, CliError
from rce_master.cli.tables import TextTable, coloured, yes_or_no

_FORBIDDEN = 403

Everything = dict[str, list[dict[str, Any]]]

_PIPED_WIDTH = 200


def console() -> Console:
    """Make a console that does not shrink tables if the output is not a terminal."""
    return Console(width=None if sys.stdout.isatty() else _PIPED_WIDTH)


def ps(
    json_: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Show robots, containers, their nodes and connections."""
    run(_ps(json_))


async def _ps(as_json: bool) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await fetch(client, "robots", "containers", "nodes", "connections", "machines")
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        console().print(_overview(found))


async def fetch(client: ApiClient, *names: str) -> Everything:
    """Get several lists at once; one that this user may not see is empty.

    Raises:
        CliError: A list cannot be read.
    """
    failure: Exception | None = None
    try:
        async with asyncio.TaskGroup() as group:
            tasks = {name: group.create_task(_fetch(client, name)) for name in names}
    except* CliError as failures:
        failure = next(errors_in(failures))
    if failure is not None:
        raise failure
    return {name: task.result() for name, task in tasks.items()}


async def _fetch(client: ApiClient, name: str) -> list[dict[str, Any]]:
    try:
        return await client.items(f"/{name}")
    except ApiError as error:
        if error.status == _FORBIDDEN:
            return []
        raise


def _overview(found: Everything) -> Group:
    robots = TextTable("robot", "state", "at", "interfaces")
    for robot in found["robots"]:
        robots.add(robot["id"], coloured(robot["state"]), robot["task_set"], str(robot["interfaces"]))
    containers = TextTable("container / node", "state", "at", "detail")
    for container in found["containers"]:
        containers.add(
            container["id"], coloured(container["state"]), _place(container, found), container["detail"]
        )
        for node in found["nodes"]:
            if (node["user"], node["container"]) == (container["user"], container["tag"]):
                what = f"{node['pkg']}/{node['exe']}"
                containers.add(f"  {node['tag']}", coloured(node["state"]), what, node["detail"])
    connections = TextTable("connection", "", "established")
    for connection in found["connections"]:
        connections.add(connection["tag_a"], connection["tag_b"], yes_or_no(connection["established"]))
    return Group(robots, "", containers, "", connections)


def _place(container: dict[str, Any], found: Everything) -> str:
    """Return a container's machine, and its next one if its machine is being drained."""
    place = str(container["machine"])
    draining = {machine["process"] for machine in found["machines"] if machine["draining"]}
    if container["moving_to"]:
        return f"{place} -> {container['moving_to']}"
    return f"{place} (draining)" if container["task_set"] in draining else place
