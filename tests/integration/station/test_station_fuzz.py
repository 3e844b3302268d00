"""Requests over HTTP that no page and no ERP would send: the station answers none with a fault of its own."""

from __future__ import annotations

from typing import Any

import pytest
from support.fuzzing import Tracebacks, exchange, requests

from rce.web.server import HttpServer
from rce_fleet.station.authentication import TokenAuthenticator
from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

COUNT = 300
PATHS = [
    *("/", "/static/{file}", "/static/../{file}", "/api/v1/openapi.json", "/api/v1/live", "/api/v1/fleet"),
    *("/api/v1/robots/{robot}", "/api/v1/robots/{robot}/goal", "/api/v1/cells/{cell}", "/api/v1/cells/1"),
    *("/api/v1/tasks", "/api/v1/tasks/{robot}/hold", "/api/v1/events", "/api/v1/history?format={file}"),
    *("/api/v1/webhooks", "/api/v1/webhooks/{robot}", "/?token={token}", "*"),
]
LOGINS = ([b"Authorization: Bearer token"], [b"Cookie: rce_station=token"])
UPGRADE = [
    b"Upgrade: websocket",
    b"Connection: Upgrade",
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    b"Sec-WebSocket-Version: 13",
]

EVENTS = '{"events": [], "next": 0, "journal": "ab", "newest": 0}'


class Planner(FleetLink):
    """Does all that it is asked for."""

    can_ask_manager = expects_manager = False

    def __init__(self) -> None:
        """Need no wire to a planner."""

    async def set_goal(self, robot: str, cell: int | None) -> str:
        return f"{robot} {cell}"

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        return {"status": 200, "body": EVENTS, "revision": '"1"'}

    async def block_cell(self, wanted: DesiredCell) -> str:
        return f"{wanted}"


@pytest.mark.parametrize("login", [*LOGINS, [*LOGINS[0], *UPGRADE]])
async def test_raw_requests_to_the_station(login: list[bytes]) -> None:
    app = Station(FleetView(), Planner(), Broadcast(), authenticator=TokenAuthenticator("token")).make_app()
    async with HttpServer(app, "127.0.0.1", 0) as server:
        port = int(server.url.rpartition(":")[2].rstrip("/"))
        with Tracebacks().watching() as log:
            for request in requests(PATHS, COUNT, login):
                answers = await exchange(port, request)
                assert 500 not in answers, request
                assert not log.found, (request, log.found)
