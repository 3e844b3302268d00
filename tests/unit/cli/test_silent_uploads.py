"""Files that are sent to a master which takes nothing of them."""

from __future__ import annotations

import asyncio
import io
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import CliError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

LARGE = 32 << 20
"""More than the network holds."""


@asynccontextmanager
async def silent_server() -> AsyncIterator[str]:
    """A server that reads nothing; yields its URL."""
    ended = asyncio.Event()

    async def hang(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        transport = writer.transport
        assert isinstance(transport, asyncio.Transport)
        transport.pause_reading()
        await ended.wait()
        transport.abort()

    async with await asyncio.start_server(hang, "127.0.0.1", 0) as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        ended.set()


async def test_master_that_takes_nothing_of_a_file_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.cli.client.REQUEST_S", 2.0)
    async with silent_server() as url, ApiClient(url) as client, asyncio.timeout(60):
        with pytest.raises(CliError, match=r"took nothing of the file for 2 s; .*; send the file again"):
            await client.upload("/packages/p/1.0", io.BytesIO(bytes(LARGE)), {})


async def test_master_that_does_not_answer_a_file_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file is in the network at once, also if the master does not read it."""
    monkeypatch.setattr("rce_master.cli.client.REQUEST_S", 3600.0)
    monkeypatch.setattr("rce_master.cli.client.UPLOAD_S", 1.0)
    async with silent_server() as url, ApiClient(url) as client, asyncio.timeout(60):
        with pytest.raises(CliError, match="cannot use the master"):
            await client.upload("/packages/p/1.0", io.BytesIO(b"small"), {})


@pytest.mark.parametrize("size", [0, 1, 3 << 20])
async def test_files_arrive_as_they_are(size: int, tmp_path: Path) -> None:
    content = (bytes(range(251)) * (size // 251 + 1))[:size]
    came: list[bytes] = []

    async def take(request: web.Request) -> web.Response:
        came.append(await request.read())
        return web.json_response({})

    app = web.Application(client_max_size=1 << 30)
    app.router.add_put("/api/v1/packages/p/1.0", take)
    async with TestServer(app) as server, ApiClient(str(server.make_url("/"))) as client:
        await client.upload("/packages/p/1.0", io.BytesIO(content), {})
        (tmp_path / "file").write_bytes(content)
        with (tmp_path / "file").open("rb") as file:
            await client.upload("/packages/p/1.0", file, {})
            assert not file.closed
    assert came == [content, content]
