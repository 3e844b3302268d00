"""Compressed bodies of strangers: refused at once, and never decompressed."""

from __future__ import annotations

import asyncio
import zlib
from typing import Any
from urllib.parse import urlsplit

import pytest
from aiohttp import web
from aiohttp.http_parser import DeflateBuffer

from rce.web.server import HttpServer

MANY_TIMES = 1000
"""So much larger is a body of zeros before it is compressed."""


@pytest.fixture
def decompressed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The encodings that the server decompressed something of."""
    found: list[str] = []
    feed_data = DeflateBuffer.feed_data

    def noted(buffer: DeflateBuffer, *arguments: Any) -> Any:
        found.append(str(buffer.encoding))
        return feed_data(buffer, *arguments)

    monkeypatch.setattr(DeflateBuffer, "feed_data", noted)
    return found


async def _read(request: web.Request) -> web.Response:
    return web.Response(text=str(len(await request.read())))


async def _send(url: str, encoding: str, body: bytes, length: int) -> bytes:
    """Send a request, of whose body not everything may come; return the head of the answer."""
    parts = urlsplit(url)
    reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
    head = f"POST / HTTP/1.1\r\nHost: {parts.netloc}\r\nContent-Length: {length}\r\n"
    writer.write(f"{head}Content-Encoding: {encoding}\r\n\r\n".encode() + body)
    try:
        async with asyncio.timeout(60):
            return await reader.readuntil(b"\r\n\r\n")
    finally:
        writer.close()


@pytest.mark.parametrize("encoding", ["gzip", "deflate", "br", "zstd"])
async def test_compressed_body_is_refused_unread(encoding: str, decompressed: list[str]) -> None:
    app = web.Application()
    app.router.add_post("/", _read)
    async with HttpServer(app, "127.0.0.1", 0) as server:
        body = zlib.compress(bytes(MANY_TIMES * 1000))
        for sent in (body, b""):  # an answer comes also if the body does not
            head = await _send(server.url, encoding, sent, len(body))
            assert head.startswith(b"HTTP/1.1 415 ")
            assert b"Accept-Encoding: identity" in head
        assert (await _send(server.url, "identity", b"four", 4)).startswith(b"HTTP/1.1 200 ")
    assert decompressed == []
