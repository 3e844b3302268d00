"""A station over HTTP for a fleet on a ROS core, without the engine."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rce.ros.types import TypeRegistry
from rce.web.server import HttpServer
from rce_fleet.station.authentication import AuditedAction, StationUser, TokenAuthenticator
from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.ros_planner_client import RosPlannerClient
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView
from support.resting_robot import PACKAGES

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


class RoleAuthenticator(TokenAuthenticator):
    """Users of an engine whose tokens are their roles."""

    has_logins = True

    def __init__(self) -> None:
        super().__init__()
        self.actions: list[AuditedAction] = []

    async def authenticate(self, token: str) -> StationUser | None:
        known = token in ("viewer", "operator", "admin", "user")
        return StationUser(f"the_{token}", token) if known else None

    def audit(self, token: str, action: AuditedAction) -> None:
        del token
        self.actions.append(action)


@asynccontextmanager
async def fleet_station(
    core_uri: str, webhooks: Path | None = None, authenticator: TokenAuthenticator | None = None
) -> AsyncIterator[str]:
    """Run a station beside a planner; return its URL."""
    view = FleetView()
    feed = Feed(view)
    fleet = FleetLink(
        RosPlannerClient(core_uri, TypeRegistry(PACKAGES)),
        view,
        on_change=feed.on_change,
        on_pose=feed.on_pose,
        on_event=feed.on_event,
        on_fleet_event=lambda text: station.fleet_api.feed.take(text),  # noqa: PLW0108 - made below
        on_planner=feed.on_planner,
    )
    station = Station(view, fleet, feed.pages, authenticator=authenticator, webhooks=webhooks)
    await station.fleet_api.load()
    ready = asyncio.Event()

    async def announce() -> None:
        ready.set()

    async with HttpServer(station.make_app(), "127.0.0.1", 0) as server, asyncio.TaskGroup() as group:
        works = (fleet.run(announce), feed.run(), station.fleet_api.run())
        tasks = [group.create_task(work) for work in works]
        async with asyncio.timeout(150):
            await ready.wait()
        yield server.url
        for task in tasks:
            task.cancel()
