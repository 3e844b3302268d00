"""A station without logins serves the user of its machine, and what a proxy passes on to it is refused."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

import aiohttp
import pytest
from aiohttp.test_utils import TestServer
from support.other_user import OTHER_USER, as_user

from rce_fleet.station.authentication import TokenAuthenticator
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView


class NoFleet(FleetLink):
    """A planner that is asked for nothing."""

    can_ask_manager = expects_manager = False

    def __init__(self) -> None:
        pass


@contextlib.asynccontextmanager
async def station(*, engine: bool = False) -> AsyncIterator[TestServer]:
    """Run a station that asks for no login, with or without an engine (which does not run)."""
    async with contextlib.AsyncExitStack() as stack:
        authenticator: EngineAuthenticator | TokenAuthenticator = TokenAuthenticator()
        if engine:
            account = StationAccount("http://127.0.0.1:1/", "anna", "pw")
            authenticator = EngineAuthenticator(account, allow_anonymous=True)
            await stack.enter_async_context(authenticator)
        app = Station(FleetView(), NoFleet(), Broadcast(), authenticator=authenticator).make_app()
        server = TestServer(app)
        await stack.enter_async_context(server)
        yield server


@pytest.mark.parametrize(
    "headers",
    [
        {"X-Forwarded-For": "192.0.2.1"},
        {"x-forwarded-proto": "https"},
        {"Forwarded": "for=192.0.2.1"},
        {"Via": "1.1 proxy"},
        {"X-Real-IP": "192.0.2.1"},
        {"Host": "192.0.2.2"},
        {"Host": "[2001:db8::1]:9080"},
    ],
)
async def test_request_that_a_proxy_marks_is_refused(headers: dict[str, str]) -> None:
    async with station() as server, aiohttp.ClientSession() as client:
        url = server.make_url("/api/v1/fleet")
        async with client.get(url, headers=headers) as reply:
            assert reply.status == 401
            assert "--token" in (await reply.json())["error"]
        async with client.get(url) as reply:
            assert reply.status == 200


async def ask(server: TestServer, head: str, *, user: int | None = None) -> str:
    """Send a request as a user; return the line of the status."""
    with contextlib.nullcontext() if user is None else as_user(user):
        made = socket.create_connection(("127.0.0.1", server.port or 0))
    with made as client:
        client.setblocking(False)
        reader, writer = await asyncio.open_connection(sock=client)
        with contextlib.closing(writer):
            writer.write(head.encode() + b"\r\n\r\n")
            return (await reader.readline()).decode()


async def test_plain_proxy_pass_of_nginx_is_refused() -> None:
    """By default nginx adds no header, has the address of the station as Host, and sends HTTP/1.0."""
    async with station() as server:
        line = await ask(server, f"GET /api/v1/fleet HTTP/1.0\r\nHost: 127.0.0.1:{server.port}")
        assert " 401 " in line


@pytest.mark.needs("root")
async def test_program_of_another_user_is_refused() -> None:
    """So is a proxy that leaves no trace in what it passes on: it runs as a user of its own."""
    async with station() as server:
        head = f"GET /api/v1/fleet HTTP/1.1\r\nHost: localhost:{server.port}"
        assert " 401 " in await ask(server, head, user=OTHER_USER)
        assert " 200 " in await ask(server, head)


@pytest.mark.needs("root")
async def test_station_started_with_sudo_serves_its_starter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUDO_UID", str(OTHER_USER))
    async with station() as server:
        head = f"GET /api/v1/fleet HTTP/1.1\r\nHost: localhost:{server.port}"
        assert " 200 " in await ask(server, head, user=OTHER_USER)


async def test_refused_page_leads_to_the_login() -> None:
    async with station(engine=True) as server, aiohttp.ClientSession() as client:
        url, proxied = server.make_url("/"), {"X-Forwarded-For": "192.0.2.1"}
        async with client.get(url, headers=proxied, allow_redirects=False) as reply:
            assert (reply.status, reply.headers["Location"]) == (303, "/login")
        async with client.get(server.make_url("/api/v1/fleet"), headers=proxied) as reply:
            assert reply.status == 401
            assert "log in" in (await reply.json())["error"]
        async with client.get(url) as reply:
            assert reply.status == 200
