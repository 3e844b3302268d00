"""The frames of a message leave in one piece."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from rce_client.socket import EngineSocket

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Counting:
    """A transport that counts what is written."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self.writes = 0

    def write(self, data: bytes) -> None:
        self.writes += 1
        self._transport.write(data)

    def __getattr__(self, name: str) -> object:
        return getattr(self._transport, name)


@pytest.fixture
async def ends() -> AsyncIterator[tuple[EngineSocket, asyncio.Queue[str | bytes]]]:
    got: asyncio.Queue[str | bytes] = asyncio.Queue()

    async def take(server: ServerConnection) -> None:
        async for message in server:
            got.put_nowait(message)

    async with serve(take, "127.0.0.1", 0, max_size=None) as server:
        port = server.sockets[0].getsockname()[1]
        async with connect(f"ws://127.0.0.1:{port}", create_connection=EngineSocket, proxy=None) as socket:
            assert isinstance(socket, EngineSocket)
            yield socket, got


async def test_frames_of_a_small_message_are_one_write(
    ends: tuple[EngineSocket, asyncio.Queue[str | bytes]],
) -> None:
    socket, got = ends
    frames: list[str | bytes] = ["text", bytes(1000), b"", "ü"]
    counting = Counting(socket.transport)
    socket.transport = counting  # type: ignore[assignment]  # it passes all on
    await socket.send_frames(frames)
    assert counting.writes == 1
    assert [await got.get() for _ in frames] == frames


async def test_large_frames_arrive_whole(ends: tuple[EngineSocket, asyncio.Queue[str | bytes]]) -> None:
    socket, got = ends
    frames: list[str | bytes] = ["text", b"\x01" * 3_000_000, b"\x02" * 70_000]
    await socket.send_frames(frames)
    assert [await got.get() for _ in frames] == frames


async def test_a_closed_connection_takes_nothing(
    ends: tuple[EngineSocket, asyncio.Queue[str | bytes]],
) -> None:
    socket, _ = ends
    await socket.close()
    with pytest.raises(ConnectionClosed):
        await socket.send_frames(["late"])
