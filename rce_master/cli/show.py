"""``rce ps`` and ``rce top``: what is there and what it consumes."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated, Any

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import ApiError

_FORBIDDEN = 403
_COLOURS = {
    "running": "green",
    "connected": "green",
    "absent": "yellow",
    "starting": "yellow",
    "placed": "yellow",
    "requested": "yellow",
    "stopping": "yellow",
    "failed": "red",
    "lost": "red",
}

Everything = dict[str, list[dict[str, Any]]]


def ps(
    json_: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Show robots, containers, their nodes and connections."""
    run(_ps(json_))


async def _ps(as_json: bool) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await fetch(client, "robots", "containers", "nodes", "connections")
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        Console().print(_overview(found))


def top(
    interval: Annotated[float, typer.Option(help="Seconds between two looks.", min=0.2)] = 1.0,
) -> None:
    """Show live what robots, containers and task sets consume; ends with Ctrl-C."""
    run(_top(interval))


async def _top(interval: float) -> None:
    before: Everything = {}
    names = ("machines", "containers", "robots", "interfaces")
    async with ApiClient.of(credentials.load()) as client:
        with Live(console=Console(), screen=True, auto_refresh=False) as live:
            while True:
                now = await fetch(client, *names)
                live.update(consumption(now, before, interval), refresh=True)
                before = now
                await asyncio.sleep(interval)


async def fetch(client: ApiClient, *names: str) -> Everything:
    """Get several lists at once; one that this user may not see is empty."""
    async with asyncio.TaskGroup() as group:
        tasks = {name: group.create_task(_fetch(client, name)) for name in names}
    return {name: task.result() for name, task in tasks.items()}


async def _fetch(client: ApiClient, name: str) -> list[dict[str, Any]]:
    try:
        return list((await client.call("GET", f"/{name}"))[name])
    except ApiError as error:
        if error.status == _FORBIDDEN:
            return []
        raise


def _overview(found: Everything) -> Group:
    robots = Table("robot", "state", "at", "interfaces", box=None)
    for robot in found["robots"]:
        robots.add_row(robot["id"], _state(robot["state"]), robot["task_set"], str(robot["interfaces"]))
    containers = Table("container / node", "state", "at", "detail", box=None)
    for container in found["containers"]:
        containers.add_row(
            container["id"], _state(container["state"]), container["machine"], container["detail"]
        )
        for node in found["nodes"]:
            if (node["user"], node["container"]) == (container["user"], container["tag"]):
                what = f"{node['pkg']}/{node['exe']}"
                containers.add_row(f"  {node['tag']}", _state(node["state"]), what, node["detail"])
    connections = Table("connection", "", "established", box=None)
    for connection in found["connections"]:
        done = "[green]yes[/]" if connection["established"] else "[yellow]no[/]"
        connections.add_row(connection["tag_a"], connection["tag_b"], done)
    return Group(robots, "", containers, "", connections)


def consumption(now: Everything, before: Everything, interval: float) -> Group:
    """Lay out what is consumed; rates are differences between two looks."""
    machines = Table("task set", "kind", "machine", "load", "cpu", "memory", box=None)
    for machine in now["machines"]:
        old = _same(before.get("machines", []), machine, "process")
        machines.add_row(
            machine["process"] if machine["connected"] else f"[red]{machine['process']} (away)[/]",
            machine["kind"],
            machine["machine"],
            str(machine["endpoints"]),
            _percent(machine, old, interval),
            _mebibytes(machine["memory_used"]),
        )
    containers = Table("container", "state", "nodes", "cpu", "memory", box=None)
    for container in now["containers"]:
        old = _same(before.get("containers", []), container, "id")
        containers.add_row(
            container["id"],
            _state(container["state"]),
            str(container["nodes"]),
            _percent(container, old, interval),
            _mebibytes(container["memory"]),
        )
    interfaces = Table("interface", "active", "in/s", "out/s", "dropped", box=None)
    for interface in now["interfaces"]:
        old = _same(before.get("interfaces", []), interface, "user", "endpoint", "tag")
        interfaces.add_row(
            f"{interface['user']}/{interface['endpoint']}/{interface['tag']}",
            "[green]yes[/]" if interface["active"] else "[yellow]no[/]",
            _rate(interface, old, "messages_in", interval),
            _rate(interface, old, "messages_out", interval),
            str(interface["dropped"]),
        )
    return Group(machines, "", containers, "", interfaces)


def _same(items: list[dict[str, Any]], item: dict[str, Any], *keys: str) -> dict[str, Any] | None:
    return next((other for other in items if all(other[key] == item[key] for key in keys)), None)


def _rate(now: dict[str, Any], old: dict[str, Any] | None, key: str, interval: float) -> str:
    return "" if old is None else f"{max(0.0, (now[key] - old[key]) / interval):.1f}"


def _percent(now: dict[str, Any], old: dict[str, Any] | None, interval: float) -> str:
    return "" if old is None else f"{max(0.0, 100 * (now['cpu_s'] - old['cpu_s']) / interval):.0f} %"


def _mebibytes(count: int) -> str:
    return f"{count / 2**20:.0f} MiB"


def _state(state: str) -> str:
    return f"[{_COLOURS.get(state, 'default')}]{state}[/]"
