"""Requests to a master that ends before it answers: no answer says that they were not done."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.ports import free_port

from rce.guard import TrustedProxies
from rce_master.cli.client import IDEMPOTENCY_KEY, ApiClient
from rce_master.cli.exceptions import ApiError, CliError
from rce_master.http.forward import Forwarder, NotForwardedError
from rce_master.http.forwarded import ForwardingKey
from rce_master.store.etcd.layout import Leader


@asynccontextmanager
async def ending_master() -> AsyncIterator[str]:
    """Give the address of a master that ends as soon as it has got a request."""

    async def end(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        server.close()
        writer.transport.abort()

    server = await asyncio.start_server(end, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
    finally:
        server.close()


@asynccontextmanager
async def silent_master() -> AsyncIterator[tuple[str, asyncio.Event]]:
    """Give the address of a master that answers nothing, and what is set when it has got a request."""
    asked = asyncio.Event()

    async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError):
            await reader.readuntil(b"\r\n\r\n")
            asked.set()
            await reader.read()
        writer.transport.abort()

    server = await asyncio.start_server(take, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/", asked
    finally:
        server.close()


@pytest.mark.parametrize("method", ["DELETE", "PUT", "GET"])
async def test_another_master_is_not_asked_for_what_may_be_done(method: str) -> None:
    asked: list[str] = []

    async def answer(request: web.Request) -> web.Response:
        asked.append(request.method)
        return web.json_response({})

    app = web.Application()
    app.router.add_route("*", "/api/v1/containers/a", answer)
    async with (
        ending_master() as first,
        TestServer(app) as second,
        ApiClient(f"{first},{second.make_url('/')}") as client,
    ):
        if method == "GET":
            await client.call(method, "/containers/a")
        else:
            with pytest.raises(CliError, match="it may have done this or not: look first"):
                await client.call(method, "/containers/a")
    assert asked == (["GET"] if method == "GET" else [])


@pytest.mark.parametrize(("method", "status"), [("DELETE", 502), ("PUT", 502), ("POST", 502), ("GET", 503)])
async def test_a_stand_by_tells_that_a_request_may_be_done(method: str, status: int) -> None:
    async with ending_master() as leader, Forwarder(ForwardingKey(b"k" * 32), TrustedProxies()) as forwarder:

        async def forward(request: web.Request) -> web.StreamResponse:
            try:
                return await forwarder.forward(request, Leader("first", 1, leader))
            except NotForwardedError:
                return web.Response(status=503)

        app = web.Application()
        app.router.add_route("*", "/a", forward)
        async with TestServer(app) as standby, aiohttp.ClientSession() as session:
            for expected in (status, 503):  # the second request finds no leader
                async with session.request(method, standby.make_url("/a")) as reply:
                    assert reply.status == expected


@pytest.mark.parametrize(("method", "status"), [("POST", 502), ("GET", 503)])
async def test_a_request_to_a_leader_that_vanished_ends_with_its_lead(method: str, status: int) -> None:
    """Its machine was cut off: no connection breaks, and TCP would go on for many minutes."""
    async with (
        silent_master() as (leader, asked),
        Forwarder(ForwardingKey(b"k" * 32), TrustedProxies()) as forwarder,
    ):

        async def forward(request: web.Request) -> web.StreamResponse:
            try:
                return await forwarder.forward(request, Leader("first", 4, leader))
            except NotForwardedError:
                return web.Response(status=503)

        app = web.Application()
        app.router.add_route("*", "/a", forward)
        async with TestServer(app) as standby, aiohttp.ClientSession() as session:
            asking = asyncio.create_task(session.request(method, standby.make_url("/a")))
            await asyncio.wait_for(asked.wait(), 30.0)
            forwarder.led_by(4)
            await asyncio.sleep(0.1)
            assert not asking.done()
            forwarder.led_by(0)
            async with await asyncio.wait_for(asking, 30.0) as reply:
                assert reply.status == status
            forwarder.led_by(5)  # it has ended


async def test_rce_repeats_what_a_leader_left_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.cli.client.RETRY_S", 0.0)
    keys: list[str] = []
    statuses = [(503, {"Retry-After": "1"}), (503, {"Retry-After": "1", "RCE-Standby": "yes"}), (201, {})]

    async def answer(request: web.Request) -> web.Response:
        keys.append(request.headers[IDEMPOTENCY_KEY])
        status, headers = statuses[len(keys) - 1]
        return web.json_response({"tag": "a"}, status=status, headers=headers)

    app = web.Application()
    app.router.add_post("/api/v1/containers", answer)
    async with TestServer(app) as server, ApiClient(str(server.make_url("/"))) as client:
        assert await client.call("POST", "/containers", {"tag": "a"}) == {"tag": "a"}
    assert len(keys) == 3
    assert len(set(keys)) == 1


@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE"])
async def test_rce_waits_while_the_lead_is_handed_over(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The former leader has ended, and the stand-by, which did nothing, takes the lead."""
    monkeypatch.setattr("rce_master.cli.client.RETRY_S", 0.01)
    answered: list[int] = []

    async def answer(_: web.Request) -> web.Response:
        answered.append(503 if len(answered) < 5 else 200)
        headers = {"Retry-After": "1", "RCE-Standby": "yes"}
        if answered[-1] == 503:
            return web.json_response({"error": "no master leads"}, status=503, headers=headers)
        return web.json_response({"tag": "a"})

    app = web.Application()
    app.router.add_route("*", "/api/v1/containers/a", answer)
    ended = f"http://127.0.0.1:{free_port()}/"
    async with TestServer(app) as server, ApiClient(f"{ended},{server.make_url('/')}") as client:
        assert await client.call(method, "/containers/a") == {"tag": "a"}
        monkeypatch.setattr("rce_master.cli.client.LEADER_S", 0.0)
        answered.clear()
        async with ApiClient(str(server.make_url("/"))) as other:
            with pytest.raises(ApiError, match="no master leads"):
                await other.call(method, "/containers/a")


async def test_rce_repeats_what_it_wanted_to_read_from_a_leader_that_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rce_master.cli.client.RETRY_S", 0.01)
    asked: list[str] = []

    async def answer(request: web.Request) -> web.Response:
        asked.append(request.method)
        status = 503 if len(asked) == 1 else 200
        return web.json_response({"error": "ask again"}, status=status, headers={"Retry-After": "1"})

    app = web.Application()
    app.router.add_route("*", "/api/v1/containers", answer)
    async with TestServer(app) as server, ApiClient(str(server.make_url("/"))) as client:
        await client.call("GET", "/containers")
        asked.clear()
        with pytest.raises(ApiError, match="ask again"):
            await client.call("DELETE", "/containers")  # it may have been done
