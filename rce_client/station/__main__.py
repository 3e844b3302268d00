"""``rce ui CONFIG``: the operator station as a program."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import uvloop

from rce.config.client import ClientConfig, load
from rce.config.exceptions import ConfigError
from rce.web.server import HttpServer
from rce_client.exceptions import RefusedError
from rce_client.station.engine_watch import EngineWatch
from rce_client.station.fleet_link import FleetLink
from rce_client.station.live import Broadcast
from rce_client.station.server import Station
from rce_client.station.view import FleetView

PORT = 9080


def ui(
    config: Annotated[
        Path, typer.Argument(help="The operator's file: user, robotID, the planner's container.")
    ],
    port: Annotated[int, typer.Option(help="Port of the page and the API; 0 takes a free one.")] = PORT,
    bind: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    token: Annotated[
        str,
        typer.Option(envvar="RCE_STATION_TOKEN", help="Callers must show it; needed beyond loopback."),
    ] = "",
) -> None:
    """Run the fleet planner in the cloud, and the page and the API that steer it."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        settings = load(config)
    except ConfigError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None
    if not token and not _is_loopback(bind):
        raise typer.BadParameter(f"--bind {bind} opens the station to others: give it a --token")
    try:
        uvloop.run(serve(settings, bind, port, token))
    except* RefusedError as group:
        typer.echo(f"rce ui: {group.exceptions[0]}", err=True)
        raise typer.Exit(1) from None
    except* OSError as group:
        typer.echo(f"rce ui: cannot listen on {bind}:{port}: {group.exceptions[0]}", err=True)
        raise typer.Exit(1) from None


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Feed:
    """Turns changes of the view into messages for the pages."""

    def __init__(self, view: FleetView, pages: Broadcast) -> None:
        self._view = view
        self._pages = pages

    def on_change(self, what: str) -> None:
        """Send what changed in the view: ``state`` or ``poses``."""
        if what == "poses":
            poses = {
                robot: (round(p.x, 3), round(p.y, 3), round(p.theta, 3))
                for robot, p in self._view.poses.items()
            }
            self._send("poses", {"poses": poses})
            return
        self._send("map", self._view.map() or {})
        robots = [{key: value for key, value in r.items() if key != "pose"} for r in self._view.robots()]
        self._send(
            "state", {"robots": robots, "blocked": self._view.blocked(), "pending": self._view.pending()}
        )

    def on_engine(self, state: dict[str, Any]) -> None:
        """Send the engine's state."""
        self._send("engine", state)

    def on_event(self, text: str, tone: str) -> None:
        """Send an event."""
        self._pages.send_event(json.dumps({"type": "event", "text": text, "tone": tone}))

    def _send(self, topic: str, message: dict[str, Any]) -> None:
        self._pages.send(topic, json.dumps({"type": topic, **message}))


async def serve(config: ClientConfig, bind: str, port: int, token: str) -> None:
    """Serve until SIGINT or SIGTERM."""
    view, pages = FleetView(), Broadcast()
    feed = Feed(view, pages)
    fleet = FleetLink(config, view, on_change=feed.on_change, on_event=feed.on_event)

    def on_engine(state: dict[str, Any]) -> None:
        feed.on_engine(state)
        fleet.on_engine(state)

    watch = EngineWatch(config.url, config.user, config.password.get_secret_value(), on_state=on_engine)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with HttpServer(Station(view, fleet, pages, token=token).make_app(), bind, port) as server:

        async def announce() -> None:
            typer.echo(f"rce ui ready: {server.url}")

        await _until(stop.wait, lambda: fleet.run(announce), watch.run)


async def _until(done: Callable[[], Any], *work: Callable[[], Any]) -> None:
    """Run ``work`` until ``done`` returns, then cancel it and wait for its end."""
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(each()) for each in work]
        await done()
        for task in tasks:
            task.cancel()


def main() -> None:
    """Run the program."""
    typer.run(ui)


if __name__ == "__main__":
    main()
