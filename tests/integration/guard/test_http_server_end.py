"""The end of an HTTP server."""

from __future__ import annotations

import asyncio
import socket

import pytest
from aiohttp import web
from support.engine import until

from rce.web.server import HttpServer

END_S = 30.0
HELLO = b"GET / HTTP/1.1\r\nHost: here\r\n\r\n"


class Waiting:
    """A server whose answers wait until they are let go."""

    def __init__(self) -> None:
        self.began, self.left = asyncio.Event(), asyncio.Event()
        app = web.Application()
        app.router.add_get("/", self._wait)
        self.server = HttpServer(app, "127.0.0.1", 0)

    async def _wait(self, request: web.Request) -> web.StreamResponse:
        self.began.set()
        await self.left.wait()
        return web.Response()

    async def ask(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Return a new connection whose request is being answered."""
        port = int(self.server.url.rsplit(":", 1)[1].strip("/"))
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(HELLO)
        await self.began.wait()
        return reader, writer


async def test_connection_that_comes_at_the_end_is_closed() -> None:
    """Its client must not be answered by what has ended."""
    waiting = Waiting()
    server = waiting.server
    await server.__aenter__()
    reader, writer = await waiting.ask()
    ending = asyncio.create_task(server.__aexit__())
    await asyncio.sleep(0.1)  # it waits for the request
    near, far = socket.socketpair()
    with near, far:
        near.setblocking(False)
        late, _ = await asyncio.get_running_loop().connect_accepted_socket(server._make_arrival, far)
        waiting.left.set()
        async with asyncio.timeout(END_S):
            await ending
        assert late.is_closing()
    writer.close()
    del reader


async def test_server_that_is_cancelled_while_it_ends_closes_all_connections() -> None:
    """A leader that loses the lead is cancelled by each part that notices, and must not go on answering."""
    waiting = Waiting()

    async def serve() -> None:
        async with waiting.server:
            await asyncio.Event().wait()

    serving = asyncio.create_task(serve())
    await until(lambda: waiting.server.url)
    reader, writer = await waiting.ask()
    serving.cancel()
    await asyncio.sleep(0.1)  # it waits for the request
    assert not serving.done()
    serving.cancel()
    async with asyncio.timeout(END_S):
        with pytest.raises(asyncio.CancelledError):
            await serving
        waiting.left.set()
        assert await reader.read() == b"", "the request was answered after the end"
    writer.close()
