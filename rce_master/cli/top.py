"""``rce top``: what machines, containers and nodes consume, live, and what could be better."""

from __future__ import annotations

import asyncio
import sys
from enum import Enum
from typing import Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from rce.model import about
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run
from rce_master.cli.machines import fetch_masters, overview_of_masters
from rce_master.cli.show import console, fetch
from rce_master.cli.tables import TextTable, coloured, plain, yes_or_no

_FULL, _BUSY = 0.9, 0.75

Usage = dict[str, Any]


class Order(Enum):
    """The value by which containers are sorted, largest first."""

    CPU = "cpu"
    MEMORY = "memory"
    IO = "io"
    LINK = "link"
    RESTARTS = "restarts"
    NAME = "name"


def top(
    interval: Annotated[float, typer.Option(help="Seconds between two updates.", min=0.2)] = 2.0,
    sort: Annotated[Order, typer.Option(help="What to sort by.")] = Order.CPU,
    nodes: Annotated[bool, typer.Option("--nodes", help="Show the nodes of each container.")] = False,
    interfaces: Annotated[bool, typer.Option("--interfaces", help="Show messages of interfaces.")] = False,
    once: Annotated[bool, typer.Option("--once", help="Print it once; so does a pipe.")] = False,
) -> None:
    """Show resource usage and advice live, until Ctrl-C."""
    once = once or not sys.stdout.isatty()
    run(_top(interval, Look(sort, nodes=nodes, interfaces=interfaces), once=once))


class Look:
    """The layout, and the previous observations."""

    def __init__(self, sort: Order, *, nodes: bool = False, interfaces: bool = False) -> None:
        self.sort = sort
        self.nodes = nodes
        self.interfaces = interfaces
        self._before: list[Usage] = []

    async def take(self, client: ApiClient, interval: float) -> RenderableType:
        """Read and show the usage once.

        Args:
            client: Connects to the master.
            interval: Seconds since the last reading.
        """
        first, containers = await client.pages("/usage", "containers")
        usage = {**first, "containers": containers, "masters": await _masters_seen(client, first)}
        parts: list[RenderableType] = [layout(usage, self)]
        if self.interfaces:
            now = (await fetch(client, "interfaces"))["interfaces"]
            parts += ["", _interfaces(now, self._before, interval)]
            self._before = now
        return Group(*parts)


async def _top(interval: float, look: Look, *, once: bool) -> None:
    async with ApiClient.of(credentials.load()) as client:
        if once:
            console().print(await look.take(client, interval))
            return
        with Live(console=console(), screen=True, auto_refresh=False) as live:
            while True:
                live.update(await look.take(client, interval), refresh=True)
                await asyncio.sleep(interval)


def layout(usage: Usage, look: Look) -> Group:
    """Format the answer of ``GET /usage``."""
    parts: list[RenderableType] = []
    if usage["machines"]:
        parts += [_machines(usage["machines"]), ""]
    if masters := usage.get("masters"):
        parts += [overview_of_masters(masters), ""]
    parts.append(_containers(usage["containers"], look))
    advice = [*_advice(usage["machines"], "process"), *_advice(usage["containers"], "id")]
    if advice:
        parts += ["", *advice]
    return Group(*parts)


async def _masters_seen(client: ApiClient, usage: Usage) -> list[Usage]:
    """Return the masters, for users who see machines."""
    return await fetch_masters(client) if usage["machines"] else []


def _machines(machines: list[Usage]) -> TextTable:
    table = TextTable("machine", "state", "containers", "slots", "cpu", "promised", "memory", "promised")
    for machine in sorted(machines, key=lambda m: (m["machine"], m["process"])):
        state = "draining" if machine["draining"] else "connected"
        table.add(
            f"{machine['machine']} ({machine['process']})",
            coloured(state if machine["connected"] else "away"),
            str(machine["containers"]),
            f"{machine['promised_slots']} of {machine['slots']}" if machine["slots"] else "",
            f"{100 * machine['cpu']:.0f} %",
            _share(machine["promised_cores"], machine["cores"]),
            about(machine["memory_used"]),
            _share(machine["promised_memory"], machine["memory"]),
        )
    return table


def _containers(containers: list[Usage], look: Look) -> TextTable:
    names = (
        "container",
        "state",
        "at",
        "cpu",
        "of limit",
        "memory",
        "of limit",
        "disk in",
        "out",
        "link in",
        "out",
    )
    table = TextTable(*names, "procs", "restarts", "oom")
    for container in sorted(containers, key=lambda c: _rank(c, look.sort)):
        table.add(
            container["id"],
            coloured(container["state"]),
            container["machine"],
            f"{100 * container['cpu']:.0f} %",
            _share(container["cpu"], container["cpu_limit"]),
            about(container["memory"]),
            _share(container["memory"], container["memory_limit"]),
            *(
                _rate(container[key])
                for key in ("io_read_rate", "io_written_rate", "link_in_rate", "link_out_rate")
            ),
            str(container["processes"]),
            _count(container["restarts"]),
            _count(container["oom_kills"]),
        )
        for node in container["nodes"] if look.nodes else ():
            cells: list[str | Text] = [
                f"  {node['tag']}",
                coloured(node["state"]),
                "",
                f"{100 * node['cpu']:.0f} %",
                "",
            ]
            cells += [about(node["memory"]), *[""] * 5, str(node["processes"]), _count(node["restarts"])]
            table.add(*cells)
    return table


def _rank(container: Usage, order: Order) -> tuple[float, str]:
    amounts: dict[Order, float] = {
        Order.CPU: container["cpu"],
        Order.MEMORY: container["memory"],
        Order.IO: container["io_read_rate"] + container["io_written_rate"],
        Order.LINK: container["link_in_rate"] + container["link_out_rate"],
        Order.RESTARTS: container["restarts"] + container["oom_kills"],
        Order.NAME: 0.0,
    }
    return -amounts[order], container["id"]


def _advice(items: list[Usage], key: str) -> list[Text]:
    lines = list[Text]()
    for item in items:
        for one in item["advice"]:
            lines.append(Text.assemble(plain(item[key], "yellow"), plain(f" {one['about']}: {one['text']}")))
            lines.append(plain(f"  {one['command']}", "bold"))
    return lines


def _interfaces(now: list[Usage], before: list[Usage], interval: float) -> TextTable:
    old = {(i["user"], i["endpoint"], i["tag"]): i for i in before}
    table = TextTable("interface", "active", "in/s", "out/s", "dropped")
    for interface in now:
        last = old.get((interface["user"], interface["endpoint"], interface["tag"]))
        rates = [
            "" if last is None else f"{max(0.0, (interface[key] - last[key]) / interval):.1f}"
            for key in ("messages_in", "messages_out")
        ]
        table.add(
            f"{interface['user']}/{interface['endpoint']}/{interface['tag']}",
            yes_or_no(interface["active"]),
            *rates,
            str(interface["dropped"]),
        )
    return table


def _share(used: float, there: float) -> Text:
    if not there:
        return Text()
    share = used / there
    colour = "red" if share > _FULL else "yellow" if share > _BUSY else "default"
    return plain(f"{share:.0%}", colour)


def _rate(count: float) -> str:
    return f"{about(count)}/s" if count else ""


def _count(number: int) -> Text:
    return plain(str(number) if number else "", "red")
