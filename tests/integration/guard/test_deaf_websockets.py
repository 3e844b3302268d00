"""The end of a WebSocket whose other side takes nothing."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest
from aiohttp import ClientSession, web
from aiohttp.test_utils import TestServer

from rce.web import closing

MUCH = bytes(8 << 20)
Step = Callable[[web.Request, web.WebSocketResponse], Awaitable[None]]


@contextlib.asynccontextmanager
async def deaf_client(step: Step) -> AsyncIterator[asyncio.Transport]:
    """A client that reads nothing; yields the server's connection once it has done a step and closed it."""
    ended: asyncio.Future[asyncio.Transport] = asyncio.get_running_loop().create_future()

    async def handle(request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(compress=False)
        await socket.prepare(request)
        transport = request.transport
        assert transport is not None
        await step(request, socket)
        await closing.close_socket(request, socket, last="the end")
        ended.set_result(transport)
        return socket

    app = web.Application()
    app.router.add_get("/", handle)
    async with (
        TestServer(app) as server,
        ClientSession() as session,
        session.get(server.make_url("/"), headers=UPGRADE) as answer,
    ):
        assert answer.status == 101
        assert answer.connection is not None
        assert answer.connection.transport is not None
        answer.connection.transport.pause_reading()
        async with asyncio.timeout(30):
            yield await ended


UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


async def test_socket_of_a_deaf_client_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The handler returns, and the connection is dropped."""
    monkeypatch.setattr(closing, "CLOSE_S", 0.3)

    async def fill(request: web.Request, socket: web.WebSocketResponse) -> None:
        assert request.transport is not None
        request.transport.write(MUCH)

    async with deaf_client(fill) as transport:
        assert transport.is_closing()


async def test_socket_is_closed_after_a_cancelled_send(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same; the handler is not cancelled by it."""
    monkeypatch.setattr(closing, "CLOSE_S", 0.3)

    async def fill(request: web.Request, socket: web.WebSocketResponse) -> None:
        with contextlib.suppress(TimeoutError):  # until the network takes nothing more
            async with asyncio.timeout(1):
                await socket.send_bytes(MUCH)

    async with deaf_client(fill) as transport:
        assert transport.is_closing()
