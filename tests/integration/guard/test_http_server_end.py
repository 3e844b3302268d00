"""The end of an HTTP server."""

from __future__ import annotations

import asyncio
import socket

from aiohttp import web

from rce.web.server import HttpServer

HELLO = b"GET / HTTP/1.1\r\nHost: here\r\n\r\n"


async def test_connection_that_comes_at_the_end_is_closed() -> None:
    """Its client must not be answered by what has ended."""
    began, left = asyncio.Event(), asyncio.Event()

    async def wait(request: web.Request) -> web.StreamResponse:
        began.set()
        await left.wait()
        return web.Response()

    app = web.Application()
    app.router.add_get("/", wait)
    server = HttpServer(app, "127.0.0.1", 0)
    await server.__aenter__()
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(HELLO)
    await began.wait()
    ending = asyncio.create_task(server.__aexit__())
    await asyncio.sleep(0.1)  # it waits for the request
    near, far = socket.socketpair()
    with near, far:
        near.setblocking(False)
        late, _ = await asyncio.get_running_loop().connect_accepted_socket(server._make_arrival, far)
        left.set()
        async with asyncio.timeout(30):
            await ending
        assert late.is_closing()
    writer.close()
    del reader
