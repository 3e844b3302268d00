"""Connections that are held open without a word lock nobody out: robots, HTTP, task sets, links."""

from __future__ import annotations

import asyncio
import socket
import ssl
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from aiohttp import ClientSession, web
from support.cloud import DIGEST, SECRET, running_cloud
from websockets.asyncio.client import connect

from rce.control.model import LinkAddress, LinkSpec
from rce.control_channel.server import ControlServer
from rce.guard.lobby import Lobby
from rce.link.exceptions import LinkRefusedError
from rce.link.frame_reader import FrameReader
from rce.link.handover import HandoverReceiver, HandoverSender, LinkAcceptor
from rce.link.handshake import check_answer, encode_hello, encode_secure
from rce.link.hub import LinkHub
from rce.link.link import Link
from rce.link.settings import LinkLimits, LinkTimeouts
from rce.tls.folder import CertificateFolder
from rce.tls.identity import Context, TlsFiles, TlsIdentity
from rce.web.server import HttpServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


ADDRESS = "127.0.0.1"
FEW = 8
MANY = 40
TIMEOUTS = LinkTimeouts(unknown_link=2.0)
"""Refusals of unknown links come later than those for want of room."""
GO = web.AppKey("go", asyncio.Event)


@asynccontextmanager
async def held_open(port: int, first: bytes = b"") -> AsyncIterator[list[socket.socket]]:
    """Hold many connections open, from one address, that come no further than their first bytes."""
    loop = asyncio.get_running_loop()
    with_all = [socket.socket() for _ in range(MANY)]
    try:
        for sock in with_all:
            sock.setblocking(False)
            await loop.sock_connect(sock, (ADDRESS, port))
            if first:
                await loop.sock_sendall(sock, first)
        yield with_all
    finally:
        for sock in with_all:
            sock.close()


async def ended(sock: socket.socket) -> bool:
    """Wait for a connection's end; false for data."""
    try:
        return await asyncio.get_running_loop().sock_recv(sock, 1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("first", [b"", b"GET /?userID=testUser HTTP/1.1\r\nHost: h\r\n"])
async def test_robots_come_in(first: bytes) -> None:
    async with running_cloud(unauthenticated_per_address=FEW) as cloud:
        port = int(cloud.ws_url.rstrip("/").rpartition(":")[2])
        async with held_open(port, first) as crowd:
            url = f"{cloud.ws_url}?userID=testUser&robotID=r&password={DIGEST}"
            async with connect(url, proxy=None) as robot:
                for sock in crowd[: MANY - FEW]:
                    assert await ended(sock)
                await (await robot.ping())


async def test_robots_that_are_known_are_not_counted() -> None:
    async with running_cloud(unauthenticated_per_address=2) as cloud, AsyncExitStack() as stack:
        robots = [
            await stack.enter_async_context(
                connect(f"{cloud.ws_url}?userID=testUser&robotID=r{n}&password={DIGEST}", proxy=None)
            )
            for n in range(6)
        ]
        for robot in robots:
            await (await robot.ping())


async def _answer(_: web.Request) -> web.Response:
    return web.Response(text="here")


async def _stream(request: web.Request) -> web.StreamResponse:
    response = web.StreamResponse()
    await response.prepare(request)
    await response.write(b"first")
    await request.app[GO].wait()
    await response.write(b"last")
    return response


@asynccontextmanager
async def web_server(tls: Context | None = None) -> AsyncIterator[tuple[HttpServer, asyncio.Event]]:
    app = web.Application()
    go = asyncio.Event()
    app[GO] = go
    app.router.add_get("/", _answer)
    app.router.add_get("/stream", _stream)
    async with HttpServer(app, ADDRESS, 0, tls, lobby=Lobby("test", per_address=FEW)) as server:
        yield server, go


@pytest.mark.parametrize(
    "first", [b"", b"GET / HTTP/1.1\r\nHost: h\r\n", b"GET / HTTP/1.1\r\nHost: h\r\n\r\n"]
)
async def test_http_answers(first: bytes) -> None:
    async with web_server() as (server, _), ClientSession() as session:
        port = int(server.url.rstrip("/").rpartition(":")[2])
        async with held_open(port, first), session.get(server.url) as response:
            assert await response.text() == "here"
        assert server.lobby.turned_away >= MANY - FEW
        assert len(server.lobby) <= FEW


@pytest.mark.parametrize("first", [b"", b"\x16", b"\x16\x03\x01\x02\x00\x01\x00"])
async def test_https_answers_beside_unfinished_handshakes(first: bytes, tmp_path: Path) -> None:
    """Connections are counted from the first byte on, not from the end of the handshake."""
    certificates = CertificateFolder(tmp_path)
    certificates.make_authority()
    certificates.issue("here", (ADDRESS,))
    files = TlsFiles(certificates.certificate("here"), certificates.key("here"))
    async with web_server(TlsIdentity(files).server) as (server, _):
        port = int(server.url.rstrip("/").rpartition(":")[2])
        async with held_open(port, first):
            trusting = ssl.create_default_context(cafile=certificates.authority)
            reader, writer = await asyncio.open_connection(ADDRESS, port, ssl=trusting)
            writer.write(b"GET / HTTP/1.1\r\nHost: h\r\nConnection: close\r\n\r\n")
            assert (await reader.read()).endswith(b"here")
            writer.close()
            await writer.wait_closed()
        assert server.lobby.turned_away >= MANY - FEW
        assert len(server.lobby) <= FEW


async def test_http_streams_go_on() -> None:
    async with web_server() as (server, go), AsyncExitStack() as stack:
        session = await stack.enter_async_context(ClientSession())
        streams = [
            await stack.enter_async_context(session.get(f"{server.url}stream")) for _ in range(2 * FEW)
        ]
        for stream in streams:
            assert await stream.content.readexactly(5) == b"first"
        async with held_open(int(server.url.rstrip("/").rpartition(":")[2])):
            go.set()
            for stream in streams:
                assert await stream.content.read() == b"last"


async def test_task_sets_come_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce.control_channel.server.UNAUTHENTICATED_PER_ADDRESS", FEW)

    async def nothing(*_: object) -> None:
        pass

    header = {"Authorization": f"Bearer {SECRET.reveal()}"}
    async with (
        ControlServer(SECRET, on_hello=nothing, on_message=nothing, on_gone=nothing, port=0) as server,
        held_open(server.port) as crowd,
        connect(f"ws://{ADDRESS}:{server.port}", additional_headers=header, proxy=None) as peer,
    ):
        for sock in crowd[: MANY - FEW]:
            assert await ended(sock)
        await (await peer.ping())


async def acceptor_for(hub: LinkHub, stack: AsyncExitStack, limits: LinkLimits) -> LinkAcceptor:
    """Make an acceptor that hands the link L over to a hub."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sender, receiver = HandoverSender(ours), HandoverReceiver(theirs, hub.adopt)
    stack.callback(sender.close)
    stack.push_async_callback(receiver.close)
    acceptor = LinkAcceptor(TIMEOUTS, limits)
    stack.push_async_callback(acceptor.close)
    await acceptor.assign(sender, ["L"])
    return acceptor


@pytest.mark.parametrize("first", [b"", encode_hello("unheard of", "t")])
@pytest.mark.parametrize("way", ["hub", "link acceptor"])
async def test_links_are_answered(way: str, first: bytes) -> None:
    limits = LinkLimits(unauthenticated_per_address=FEW)
    async with AsyncExitStack() as stack:
        hub = LinkHub("here", TIMEOUTS, limits)
        stack.push_async_callback(hub.close)
        if way == "hub":
            port = await hub.listen_tcp(ADDRESS, 0)
            lobby = hub.lobby
        else:
            acceptor = await acceptor_for(hub, stack, limits)
            port = await acceptor.listen(ADDRESS, 0)
            lobby = acceptor.lobby
        async with held_open(port, first) as crowd:
            for sock in crowd[: MANY - FEW]:
                assert await ended(sock)
            assert len(lobby) == FEW
            reader, writer = await asyncio.open_connection(ADDRESS, port)
            writer.write(encode_hello("L", "wrong"))
            with pytest.raises(LinkRefusedError):
                check_answer(FrameReader(limits).feed(await reader.read(1000))[0])
            writer.close()
            await writer.wait_closed()


async def test_tls_handshakes_of_links_are_counted() -> None:
    """The process that has the link counts them, also if another one accepted the connections."""
    limits = LinkLimits(unauthenticated_per_address=FEW)
    async with AsyncExitStack() as stack:
        hub = LinkHub("here", LinkTimeouts(handshake=60.0), limits)
        stack.push_async_callback(hub.close)
        spec = LinkSpec(id="L", peer="u/a", token="secret", dial=False, address=LinkAddress())
        hub.register(Link(spec, limits))
        acceptor = await acceptor_for(hub, stack, LinkLimits())
        port = await acceptor.listen(ADDRESS, 0)
        async with asyncio.timeout(60), held_open(port, encode_secure("L")):
            while hub.lobby.turned_away < MANY - FEW:
                await asyncio.sleep(0.01)
            assert len(hub.lobby) == FEW
        async with asyncio.timeout(60):
            while hub.lobby:
                await asyncio.sleep(0.01)
        assert not hub._carriers
