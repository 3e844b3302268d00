"""Requests over HTTP that no client would send: the master answers none with a fault of its own."""

from __future__ import annotations

import asyncio
import re
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest
from aiohttp import web
from support.fuzzing import Tracebacks, exchange, requests

from rce.config import Secret
from rce.guard import TrustedProxies
from rce.web.server import HttpServer
from rce_master.http.api import ROUTES
from rce_master.http.forward import Forwarder
from rce_master.http.forwarded import ForwardingKey
from rce_master.http.standby import make_standby_app

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from integration.master.conftest import Site

    from rce_master.follower import StateFollower
    from rce_master.leadership.keeper import LeadershipKeeper

COUNT = 600
PREFIX = "/api/v1"
PATHS = [PREFIX + route.path for route in ROUTES]
PATHS += ["/", "/healthz", "/metrics", f"{PREFIX}/openapi.json", "/nothing", "*", "http://[::1"]
OWN = ("/healthz", "/metrics")
"""What a stand-by answers itself."""
FAULTS = {500, 501, 502, 504}


@pytest.fixture
async def world(site: Site) -> AsyncIterator[Site]:
    """A master with something in it."""
    async with site.containers() as machine, site.robots():
        machine.log = b"hello\n"
        await site.api("POST", "/containers", {"tag": "box"}, status=204)
        node = {"tag": "talker", "pkg": "Test", "exe": "run.py"}
        await site.api("POST", "/containers/box/nodes", node, status=204)
        yield site


async def test_raw_requests(world: Site) -> None:
    port = int(world.url.rpartition(":")[2].rstrip("/"))
    login = [b""]
    with Tracebacks().watching() as log:
        for number, request in enumerate(requests(PATHS, COUNT, login)):
            if number % 25 == 0:
                login[0] = b"Authorization: Bearer " + (await world.login()).encode()
            answers = await exchange(port, request)
            assert not FAULTS & set(answers), request
            assert not log.found, (request, log.found)


async def test_raw_requests_to_a_standby() -> None:
    """It sends them on to a leader, which refuses them all."""

    async def refuse(_: web.Request) -> web.Response:
        return web.json_response({"error": "no"}, status=401)

    leading = web.Application()
    leading.router.add_route("*", "/{rest:.*}", refuse)
    key = ForwardingKey(Secret("secret of the tests"))
    async with HttpServer(leading, "127.0.0.1", 0) as leader, Forwarder(key, TrustedProxies()) as forwarder:
        member = SimpleNamespace(url=leader.url, name="m1", term=1)
        keeper = cast("LeadershipKeeper", SimpleNamespace(leader=member, fault="", is_drained=False))
        app = make_standby_app(keeper, cast("StateFollower", SimpleNamespace()), forwarder, ())
        async with HttpServer(app, "127.0.0.1", 0) as standby:
            port = int(standby.url.rpartition(":")[2].rstrip("/"))
            with Tracebacks().watching() as log:
                for request in requests([path for path in PATHS if path not in OWN], COUNT // 4):
                    answers = await exchange(port, request)
                    assert not FAULTS & set(answers), request
                    assert not log.found, (request, log.found)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/containers/my-box/log", 404),
        ("/containers/my-box/nodes/n/log", 404),
        ("/containers/box/nodes/my-node/log", 404),
        ("/containers/box/log?limit=%ff", 422),
        ("/containers/box/log?offset=\u0661", 422),
        ("/robots?user=%ed%a0%80", 404),
        ("/packages/a%2fb/%ff", 404),
    ],
)
async def test_names_that_are_none(world: Site, path: str, status: int) -> None:
    with Tracebacks().watching() as log:
        reply = await world.api("GET", path, status=status)
        assert reply["error"]
        assert not log.found


@pytest.mark.parametrize("token", [b"\xff\xfe", "tok\u00e9n".encode(), b"rce_\x80", b"a b", b"="])
async def test_tokens_that_are_none(world: Site, token: bytes) -> None:
    port = int(world.url.rpartition(":")[2].rstrip("/"))
    request = b"GET /api/v1/user HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer %s\r\n\r\n" % token
    with Tracebacks().watching() as log:
        assert await exchange(port, request, whole=True) == [401]
        assert not log.found


async def test_every_route_answers_who_has_no_token(site: Site) -> None:
    """As the OpenAPI document says of each."""
    document = await site.api("GET", "/openapi.json", token="")

    async def ask(method: str, path: str, known: dict[str, Any]) -> None:
        url = site.url.rstrip("/") + re.sub(r"{\w+}", "box", path)
        async with site.session.request(method, url) as reply:
            assert str(reply.status) in known["responses"], (method, path, reply.status)
            assert known.get("security") == [] or reply.status == 401
            assert (await reply.json())["error"]

    await asyncio.gather(
        *(
            ask(method, path, known)
            for path, methods in document["paths"].items()
            for method, known in methods.items()
        )
    )
