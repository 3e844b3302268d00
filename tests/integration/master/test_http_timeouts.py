"""Clients of the HTTP server that do not come to the point."""

from __future__ import annotations

import asyncio

import pytest
from aiohttp import web

from rce.config.settings import LOOPBACK
from rce.web.server import HttpServer


@pytest.mark.parametrize(
    "begun", [b"", b"GET / HTTP/1.1\r\nHost: a\r\nX-Slow: ", b"GET / HTTP/1.1\r\nHost: a\r\n\r\nGET / HT"]
)
async def test_a_request_without_an_end_is_given_up(begun: bytes) -> None:
    async def answer(_: web.Request) -> web.Response:
        return web.Response(text="hello")

    app = web.Application()
    app.router.add_get("/", answer)
    async with HttpServer(app, LOOPBACK, 0, idle_timeout=0.05) as server:
        port = int(server.url.rsplit(":", 1)[1].strip("/"))
        reader, writer = await asyncio.open_connection(LOOPBACK, port)
        writer.write(begun)
        await reader.read()
        writer.close()
        await writer.wait_closed()
