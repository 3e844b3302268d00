"""A server that loads its application with the first request that needs it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from aiohttp import ClientConnectionError, ClientSession, web

from rce.config.settings import LOOPBACK
from rce.guard.lobby import Lobby
from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity
from rce.web.entry import EntryAnswer
from rce.web.server import HttpServer, LateApplication


class Site:
    """Counts how often its application is loaded."""

    def __init__(self) -> None:
        self.loaded = 0
        self.fault: Exception | None = None

    def load(self) -> Callable[[], web.Application]:
        self.loaded += 1
        if self.fault is not None:
            raise self.fault
        return self.make

    def make(self) -> web.Application:
        async def answer(request: web.Request) -> web.Response:
            return web.Response(text=f"application: {request.path}")

        app = web.Application()
        app.router.add_route("*", "/{rest:.*}", answer)
        return app

    @asynccontextmanager
    async def served(self, idle_timeout: float = 30.0) -> AsyncIterator[HttpServer]:
        def entry(query: str) -> EntryAnswer:
            return EntryAnswer(200, f"entry: {query}".encode(), "text/plain")

        late = LateApplication(self.load, entry)
        async with HttpServer(late, LOOPBACK, 0, idle_timeout=idle_timeout, lobby=Lobby("test")) as server:
            yield server


@pytest.fixture
def site() -> Site:
    return Site()


def port_of(server: HttpServer) -> int:
    return int(server.url.rsplit(":", 1)[1].strip("/"))


async def test_robots_do_not_load_the_application(site: Site) -> None:
    async with site.served() as server, ClientSession() as session:
        for _ in range(3):
            async with session.get(f"{server.url}?userID=a") as reply:
                assert await reply.text() == "entry: userID=a"
        assert not site.loaded


async def test_requests_at_once_load_it_once(site: Site) -> None:
    async with site.served() as server, ClientSession() as session:

        async def ask(path: str) -> str:
            async with session.post(f"{server.url}{path}", data=b"x" * 100_000) as reply:
                return await reply.text()

        paths = [f"path{number}" for number in range(10)]
        assert await asyncio.gather(*map(ask, paths)) == [f"application: /{path}" for path in paths]
        assert site.loaded == 1
        async with session.get(server.url) as reply:
            assert await reply.text() == "application: /"


async def test_one_connection_has_both_answers(site: Site) -> None:
    async with site.served() as server:
        reader, writer = await asyncio.open_connection(LOOPBACK, port_of(server))
        writer.write(b"GET /?q HTTP/1.1\r\nHost: h\r\n\r\n")
        assert b"entry: q" in await reader.readuntil(b"entry: q")
        writer.write(b"GET /else HTTP/1.1\r\nHost: h\r\nConnection: close\r\n\r\n")
        assert (await reader.read()).endswith(b"application: /else")
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize("begun", [b"", b"GET /?a", b"GET /?a HTTP/1.1\r\nHost: h\r\n\r\nGET /"])
async def test_a_silent_connection_is_closed(site: Site, begun: bytes) -> None:
    async with site.served(idle_timeout=0.05) as server:
        reader, writer = await asyncio.open_connection(LOOPBACK, port_of(server))
        writer.write(begun)
        await reader.read()
        writer.close()
        await writer.wait_closed()


async def test_a_client_that_leaves_while_it_loads_harms_nothing(site: Site) -> None:
    async with site.served() as server, ClientSession() as session:
        _, writer = await asyncio.open_connection(LOOPBACK, port_of(server))
        writer.write(b"GET /else HTTP/1.1\r\nHost: h\r\n\r\n")
        writer.transport.abort()
        async with session.get(f"{server.url}here") as reply:
            assert await reply.text() == "application: /here"


async def test_an_application_that_fails_is_loaded_again(
    site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    """Its clients are sent away, robots still find their way."""
    site.fault = ImportError("a broken installation")
    async with site.served() as server, ClientSession() as session:
        with pytest.raises(ClientConnectionError):
            async with session.post(f"{server.url}else", data=b""):
                pass
        assert "the application cannot be loaded" in caplog.text
        async with session.get(f"{server.url}?a") as reply:
            assert await reply.text() == "entry: a"
        site.fault = None
        async with session.post(f"{server.url}else") as reply:
            assert await reply.text() == "application: /else"


async def test_entry_and_application_behind_tls(site: Site, tmp_path: Path) -> None:
    folder = CertificateFolder(tmp_path)
    folder.make_authority()
    folder.issue("here", (LOOPBACK,))
    identity = TlsIdentity(
        TlsFiles(folder.certificate("here"), folder.key("here"), authority=folder.authority)
    )
    late = LateApplication(site.load, lambda query: EntryAnswer(200, query.encode(), "text/plain"))
    async with HttpServer(late, LOOPBACK, 0, identity.server) as server, ClientSession() as session:
        async with session.get(f"{server.url}?a", ssl=identity.client()) as reply:
            assert await reply.text() == "a"
        assert not site.loaded
        async with session.get(f"{server.url}else", ssl=identity.client()) as reply:
            assert await reply.text() == "application: /else"
