"""Clients of an HTTP server that ask, and take nothing of the answer."""

from __future__ import annotations

import asyncio
import contextlib
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from aiohttp import ClientSession, web

from rce.config.settings import LOOPBACK
from rce.web import writing
from rce.web.server import HttpServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

LARGE = bytes(24 << 20)
"""More than the buffers of two sockets."""


class LargeAnswers:
    """An application with a large answer and an endless stream; it notes the connections."""

    def __init__(self) -> None:
        self.asked: list[asyncio.Transport] = []
        self.app = web.Application()
        self.app.router.add_get("/whole", self.whole)
        self.app.router.add_get("/stream", self.stream)

    def _note(self, request: web.Request) -> None:
        assert request.transport is not None
        self.asked.append(request.transport)

    async def whole(self, request: web.Request) -> web.Response:
        self._note(request)
        return web.Response(body=LARGE)

    async def stream(self, request: web.Request) -> web.StreamResponse:
        self._note(request)
        response = web.StreamResponse()
        await response.prepare(request)
        with contextlib.suppress(ConnectionError):
            while True:
                await writing.write(request, response, LARGE)
        return response

    async def until_asked(self, number: int) -> None:
        while len(self.asked) < number:
            await asyncio.sleep(0.01)

    async def until_cut_off(self, number: int) -> None:
        while not self.asked[number].is_closing():
            await asyncio.sleep(0.01)


@asynccontextmanager
async def deaf_client(server: HttpServer, path: str) -> AsyncIterator[None]:
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    # A reader that is not asked takes no more than its limit.
    _, writer = await asyncio.open_connection(LOOPBACK, port, limit=1024)
    writer.write(f"GET /{path} HTTP/1.1\r\nHost: {LOOPBACK}\r\n\r\n".encode())
    try:
        yield
    finally:
        writer.transport.abort()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


@pytest.mark.parametrize("path", ["whole", "stream"])
async def test_a_client_that_takes_nothing_is_cut_off(monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    monkeypatch.setattr(writing, "WRITE_S", 0.2)
    monkeypatch.setattr(writing, "LEAST_RATE", 1 << 40)
    answers = LargeAnswers()
    async with (
        HttpServer(answers.app, LOOPBACK, 0) as server,
        asyncio.timeout(60),
        deaf_client(server, path),
    ):
        await answers.until_asked(1)
        await answers.until_cut_off(0)


async def test_of_too_much_that_is_unread_the_oldest_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "MAX_UNREAD", 2 * len(LARGE))
    answers = LargeAnswers()
    async with (
        HttpServer(answers.app, LOOPBACK, 0) as server,
        AsyncExitStack() as stack,
        ClientSession() as session,
        asyncio.timeout(60),
    ):
        for number in range(1, 3):
            await stack.enter_async_context(deaf_client(server, "whole"))
            await answers.until_asked(number)
        assert not any(transport.is_closing() for transport in answers.asked)
        async with session.get(f"{server.url}whole") as reply:
            assert await reply.read() == LARGE, "one that reads is served"
        await answers.until_cut_off(0)
        assert not answers.asked[1].is_closing()
