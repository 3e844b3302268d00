"""Requests to a master that ends before it answers: no answer says that they were not done."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer, make_mocked_request
from support.absent_masters import silent_master, unreachable_port
from support.ports import free_port

from rce.config import Secret
from rce.guard import TrustedProxies
from rce.tls.identity import TlsFiles, TlsIdentity
from rce_master.cli.client import IDEMPOTENCY_KEY, ApiClient
from rce_master.cli.exceptions import ApiError, CliError
from rce_master.http import forward as forwarding
from rce_master.http.forward import Forwarder, NotForwardedError
from rce_master.http.forwarded import ForwardingKey
from rce_master.store.etcd.layout import Leader

FORWARDING = ForwardingKey(Secret("the secret of the masters"))


@asynccontextmanager
async def ending_master() -> AsyncIterator[str]:
    """Give the address of a master that ends as soon as it has got a request, but for one of its health."""

    async def end(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if (await reader.readuntil(b"\r\n\r\n")).startswith(b"GET /healthz "):
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            writer.close()
            return
        server.close()
        writer.transport.abort()

    server = await asyncio.start_server(end, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
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
    async with ending_master() as leader, Forwarder(FORWARDING, TrustedProxies()) as forwarder:

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


@pytest.mark.parametrize(("method", "status"), [("DELETE", 502), ("POST", 502), ("GET", 503)])
async def test_no_stand_by_denies_what_it_did_as_leader(method: str, status: int) -> None:
    """It loses the lead as it answers; aiohttp repeats a DELETE then, which finds a stand-by."""
    asked = 0

    async def answer(request: web.Request) -> web.Response:
        nonlocal asked
        asked += 1
        if asked == 1 and request.transport is not None:
            request.transport.abort()
        return web.Response(status=503, headers={"RCE-Standby": "yes"})

    async def forward(request: web.Request) -> web.StreamResponse:
        try:
            return await forwarder.forward(request, Leader("first", 1, str(leader.make_url("/"))))
        except NotForwardedError:
            return web.Response(status=503, headers={"RCE-Standby": "yes"})

    masters = [web.Application() for _ in range(2)]
    masters[0].router.add_route("*", "/a", answer)
    masters[1].router.add_route("*", "/a", forward)
    async with (
        TestServer(masters[0]) as leader,
        TestServer(masters[1]) as standby,
        Forwarder(FORWARDING, TrustedProxies()) as forwarder,
        aiohttp.ClientSession() as session,
        session.request(method, standby.make_url("/a")) as reply,
    ):
        assert reply.status == status
        assert ("RCE-Standby" in reply.headers) == (method == "GET")


@pytest.mark.parametrize(("media", "status"), [("application/gzip", 200), ("application/json", 502)])
async def test_a_leader_has_longer_to_answer_an_upload(
    monkeypatch: pytest.MonkeyPatch, media: str, status: int
) -> None:
    """It looks at an archive, and copies it to other masters, before it answers."""
    monkeypatch.setattr(forwarding, "SILENCE_S", 0.2)

    async def answer(request: web.Request) -> web.Response:
        await request.read()
        await asyncio.sleep(2.0)
        return web.Response()

    async def pass_on(request: web.Request) -> web.StreamResponse:
        return await forwarder.forward(request, Leader("first", 1, str(leader.make_url("/"))))

    masters = [web.Application() for _ in range(2)]
    masters[0].router.add_route("*", "/a", answer)
    masters[1].router.add_route("*", "/a", pass_on)
    async with (
        TestServer(masters[0]) as leader,
        TestServer(masters[1]) as standby,
        Forwarder(FORWARDING, TrustedProxies()) as forwarder,
        aiohttp.ClientSession() as session,
        session.put(standby.make_url("/a"), data=b"{}", headers={"Content-Type": media}) as reply,
    ):
        assert reply.status == status


@pytest.mark.parametrize(("method", "status"), [("POST", 502), ("GET", 503)])
async def test_a_request_to_a_leader_that_vanished_ends_with_its_lead(method: str, status: int) -> None:
    """Its machine was cut off: no connection breaks, and TCP would go on for many minutes."""
    async with (
        silent_master() as (leader, asked),
        Forwarder(FORWARDING, TrustedProxies()) as forwarder,
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
        monkeypatch.setattr("rce_master.cli.attempts.LEADER_S", 0.0)
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


class Answering:
    """A master that counts what it is asked, but for its health."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.keys: set[str] = set()

    async def answer(self, request: web.Request) -> web.StreamResponse:
        if request.path == "/healthz":
            return web.json_response({})
        self.asked.append(f"{request.method} {request.path.removeprefix('/api/v1')}")
        self.keys.add(request.headers.get(IDEMPOTENCY_KEY, ""))
        if request.path.endswith("/exec"):
            socket = web.WebSocketResponse()
            await socket.prepare(request)
            await socket.close()
            return socket
        if request.path.endswith("/events"):
            return web.Response(text='data: {"id":1,"time":1,"kind":"k","user":"u","subject":"u/c"}\n\n')
        return web.json_response({"tag": "a"})

    @asynccontextmanager
    async def running(self) -> AsyncIterator[str]:
        app = web.Application()
        app.router.add_route("*", "/{rest:.*}", self.answer)
        async with TestServer(app) as server:
            yield str(server.make_url("/"))


@asynccontextmanager
async def absent_master(fault: str) -> AsyncIterator[str]:
    if fault == "unreachable":
        with unreachable_port() as port:
            yield f"http://127.0.0.1:{port}/"
    else:
        async with silent_master() as (url, _):
            yield url


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each master have little time, and the whole of a request much more than a test has."""
    monkeypatch.setattr("rce_master.cli.client.REQUEST_S", 600.0)
    monkeypatch.setattr("rce_master.cli.client.CONNECT_S", 1.0)
    monkeypatch.setattr("rce_master.cli.client.ANSWER_S", 2.0)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("fault", ["silent", "unreachable"])
@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE"])
async def test_the_next_master_is_asked_if_one_is_absent(method: str, fault: str) -> None:
    """It answers nothing at all: its program is stopped, or its machine is off."""
    master = Answering()
    async with (
        absent_master(fault) as absent,
        master.running() as url,
        ApiClient(f"{absent},{absent},{url}") as client,
        asyncio.timeout(60),
    ):
        assert await client.call(method, "/containers/a") == {"tag": "a"}
        assert await client.call(method, "/containers/b") == {"tag": "a"}
    if method in ("GET", "POST"):  # these may be asked again
        master.asked = sorted(set(master.asked))
    assert master.asked == [f"{method} /containers/a", f"{method} /containers/b"]
    assert len(master.keys) == (2 if method == "POST" else 1)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("fault", ["silent", "unreachable"])
async def test_streams_find_a_master_that_answers(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.cli.client.RETRY_S", 0.0)
    master = Answering()
    async with absent_master(fault) as absent, master.running() as url, asyncio.timeout(60):
        async with (
            ApiClient(f"{absent},{url}") as client,
            client.websocket("/exec", {}, 1 << 20) as socket,
        ):
            await socket.receive()
        async with ApiClient(f"{absent},{url}") as client:
            async for event in client.events():
                assert event.id == 1
                break
    assert master.asked == ["GET /exec", "GET /events"]


@pytest.mark.usefixtures("impatient")
async def test_a_slow_master_is_asked_again_with_more_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.cli.client.RETRY_S", 0.0)
    asked: list[str] = []

    async def answer(request: web.Request) -> web.Response:
        asked.append(request.path)
        if len(asked) <= 2:
            await asyncio.Event().wait()  # until the client has given up
        await asyncio.sleep(2.5)
        return web.json_response({})

    app = web.Application()
    app.router.add_get("/api/v1/user", answer)
    async with TestServer(app) as server, asyncio.timeout(60):
        url = str(server.make_url("/"))
        async with ApiClient(f"{url},{url}") as client:
            await client.call("GET", "/user")
    assert len(asked) == 3


@pytest.mark.usefixtures("impatient")
async def test_what_a_silent_master_may_have_done_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """It answered before, and hangs now: what was sent is not sent to another master."""
    monkeypatch.setattr("rce_master.cli.client.REQUEST_S", 2.0)
    master = Answering()
    async with (
        silent_master() as (silent, asked),
        master.running() as url,
        ApiClient(f"{silent},{url}") as client,
        asyncio.timeout(60),
    ):
        client._answered = silent
        with pytest.raises(CliError, match=f"{silent}api/v1.*it may have done this or not: look first"):
            await client.call("DELETE", "/containers/a")
        assert asked.is_set()
    assert master.asked == []


async def test_a_stand_by_with_unusable_certificates_says_which(tmp_path: Path) -> None:
    """It has not asked the leader; the request may be sent to another master."""
    (tmp_path / "authority.pem").write_text("no certificate")
    identity = TlsIdentity(TlsFiles(authority=tmp_path / "authority.pem"))

    async with Forwarder(FORWARDING, TrustedProxies(), identity.client) as forwarder:
        request = make_mocked_request("POST", "/a")
        with pytest.raises(NotForwardedError, match=r"first leads; .*authority\.pem"):
            await forwarder.forward(request, Leader("first", 4, "https://127.0.0.1:9/"))
