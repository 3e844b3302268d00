"""The demo's HTTP clients, of station and master, against a fake server."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.fleet_states import fleet, robot

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.traffic import MessageTotals, read_engine_totals
from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.station.client import StationClient

FLEET = fleet(robot("Robot1", cell=3), blocked=[5])


class FakeServer:
    """A server with the routes of station and master."""

    def __init__(self) -> None:
        self.requests: list[tuple[str, Any]] = []
        self.answer: web.Response | None = None

    def app(self) -> web.Application:
        app = web.Application()
        app.router.add_get("/api/v1/fleet", self.fleet)
        app.router.add_put("/api/v1/{path:.*}", self.put)
        app.router.add_post("/api/v1/login", self.login)
        app.router.add_delete("/api/v1/login", self.logout)
        app.router.add_get("/api/v1/interfaces", self.interfaces)
        return app

    async def fleet(self, _: web.Request) -> web.Response:
        return self.answer or web.Response(text=FLEET.model_dump_json(), content_type="application/json")

    async def put(self, request: web.Request) -> web.Response:
        self.requests.append((request.match_info["path"], await request.json()))
        return self.answer or web.json_response({"message": "done"})

    async def login(self, _: web.Request) -> web.Response:
        return self.answer or web.json_response({"token": "abc"})

    async def logout(self, request: web.Request) -> web.Response:
        self.requests.append(("logout", request.headers["Authorization"]))
        return web.Response(status=204)

    async def interfaces(self, request: web.Request) -> web.Response:
        assert request.headers["Authorization"] == "Bearer abc"
        counted = [{"messages_in": 3, "dropped": 0}, {"messages_in": 4, "dropped": 1}]
        return web.json_response({"interfaces": counted})


@pytest.fixture
def fake() -> FakeServer:
    return FakeServer()


@pytest.fixture
async def server(fake: FakeServer) -> AsyncIterator[TestServer]:
    server = TestServer(fake.app())
    async with server:
        yield server


@pytest.fixture
async def session() -> AsyncIterator[aiohttp.ClientSession]:
    async with aiohttp.ClientSession() as session:
        yield session


async def test_state_is_read_and_requests_are_sent(
    fake: FakeServer, server: TestServer, session: aiohttp.ClientSession
) -> None:
    station = StationClient(session, str(server.make_url("/")))
    assert await station.fleet() == FLEET
    await station.set_goal("Robot1", 7)
    await station.set_goal("Robot1", None)
    await station.set_blocked(9, blocked=True)
    assert fake.requests == [
        ("robots/Robot1/goal", {"cell": 7}),
        ("robots/Robot1/goal", {"cell": None}),
        ("cells/9", {"blocked": True}),
    ]


@pytest.mark.parametrize(
    ("status", "error"),
    [(409, RequestRefusedError), (404, RequestRefusedError), (503, StationUnavailableError)],
)
async def test_refusals(
    status: int,
    error: type[Exception],
    fake: FakeServer,
    server: TestServer,
    session: aiohttp.ClientSession,
) -> None:
    fake.answer = web.json_response({"error": "cell 9 is a wall"}, status=status)
    with pytest.raises(error, match="cell 9 is a wall"):
        await StationClient(session, str(server.make_url("/"))).set_blocked(9, blocked=True)


async def test_answer_that_is_not_a_state_is_refused(
    fake: FakeServer, server: TestServer, session: aiohttp.ClientSession
) -> None:
    fake.answer = web.json_response({"robots": 3})
    with pytest.raises(RequestRefusedError, match="is not a fleet's state"):
        await StationClient(session, str(server.make_url("/"))).fleet()


async def test_unreachable_server_is_an_error(server: TestServer, session: aiohttp.ClientSession) -> None:
    url = str(server.make_url("/"))
    await server.close()
    with pytest.raises(StationUnavailableError):
        await StationClient(session, url).fleet()
    with pytest.raises(DemoError):
        await read_engine_totals(url, "u", "p")


async def test_totals_are_summed_and_the_token_is_revoked(fake: FakeServer, server: TestServer) -> None:
    assert await read_engine_totals(str(server.make_url("/")), "u", "p") == MessageTotals(7, 1)
    assert fake.requests == [("logout", "Bearer abc")]


async def test_a_refused_login(fake: FakeServer, server: TestServer) -> None:
    fake.answer = web.json_response({"error": "wrong"}, status=401)
    with pytest.raises(DemoError, match="401"):
        await read_engine_totals(str(server.make_url("/")), "u", "p")
