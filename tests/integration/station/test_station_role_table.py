"""Which roles may use which route of a station, of all routes."""

from __future__ import annotations

import re
from typing import Any

import aiohttp
import pytest
from aiohttp import hdrs, web
from aiohttp.test_utils import TestServer
from support.fleet_station import RoleAuthenticator

from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

PUBLIC = {"GET /login", "POST /login", "DELETE /login", "GET /openapi.json"}
"""For requests without a token, too."""
START = {"GET /"}
"""Without a token, it leads to the login."""
VIEWERS = {
    "GET /me",
    "GET /live",
    "GET /fleet",
    "GET /robots",
    "GET /robots/{robot}",
    "GET /robots/{robot}/manager",
    "GET /tasks",
    "GET /tasks/{id}",
    "GET /chargers",
    "GET /zones",
    "GET /zones/{id}",
    "GET /map",
    "GET /statistics",
    "GET /events",
    "GET /history",
    "GET /replay",
    "GET /replay/{at}",
    "GET /figures",
}
OPERATORS = {
    "PUT /emergency-stop",
    "PUT /robots/{robot}/emergency-stop",
    "PUT /robots/{robot}/pose",
    "GET /robots/{robot}/drive",
    "PUT /mode",
    "PUT /robots/{robot}/goal",
    "PUT /cells/{cell}",
    "POST /grid/preview",
    "PUT /grid",
    "POST /simulation",
    "POST /masters/kill-leader",
    "POST /tasks",
    "DELETE /tasks",
    "PATCH /tasks/{id}",
    "DELETE /tasks/{id}",
    "POST /tasks/{id}/hold",
    "POST /tasks/{id}/resume",
    "POST /tasks/{id}/confirm",
    "POST /tasks/{id}/load",
    "POST /tasks/{id}/reassign",
    "PATCH /robots/{robot}",
    "POST /robots/{robot}/pause",
    "POST /robots/{robot}/resume",
    "POST /robots/{robot}/take-out",
    "POST /robots/{robot}/put-in",
    "PUT /chargers",
    "PUT /zones/{id}",
    "DELETE /zones/{id}",
}
"""What changes something."""
ADMINISTRATORS = {"GET /webhooks", "POST /webhooks", "DELETE /webhooks/{webhook}"}
ALL = PUBLIC | START | VIEWERS | OPERATORS | ADMINISTRATORS
REFUSED = {
    "": ALL - PUBLIC - START,
    "user": ALL - PUBLIC,  # of another fleet
    "viewer": OPERATORS | ADMINISTRATORS,
    "operator": ADMINISTRATORS,
    "admin": set[str](),
}


class AwayFleet(FleetLink):
    """A planner and a manager that do not answer."""

    can_ask_manager = expects_manager = False

    def __init__(self) -> None:
        """Need no wire to a planner."""

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        raise PlannerUnavailableError(f"{request['path']} is not answered")


def routes_of(app: web.Application) -> dict[str, str]:
    """Return a path to request for each route but those of static files."""
    found = {}
    for route in app.router.routes():
        assert route.resource is not None
        path = route.resource.canonical.removeprefix("/api/v1")
        if not isinstance(route.resource, web.StaticResource) and route.method != hdrs.METH_HEAD:
            prefix = "/api/v1" if route.resource.canonical.startswith("/api/v1/") else ""
            found[f"{route.method} {path}"] = prefix + re.sub(r"\{\w+\}", "7", path)
    return found


@pytest.mark.parametrize("role", REFUSED)
async def test_a_role_may_use_its_routes_and_no_others(role: str) -> None:
    """A new route needs a row; what is refused to a user who sees the fleet is in the audit log."""
    users = RoleAuthenticator()
    app = Station(FleetView(), AwayFleet(), Broadcast(), authenticator=users).make_app()
    paths = routes_of(app)
    assert paths.keys() == ALL
    headers = {"Authorization": f"Bearer {role}"} if role else {}
    refused = set()
    async with TestServer(app) as server, aiohttp.ClientSession(server.make_url("/")) as session:
        for name, path in paths.items():
            method = name.partition(" ")[0]
            async with session.request(method, path, headers=headers, allow_redirects=False) as reply:
                if reply.status == (403 if role else 401):
                    refused.add(name)
    assert refused == REFUSED[role]
    noted = 0 if role in ("", "user") else len(refused)
    assert [action.done for action in users.actions] == [False] * noted
