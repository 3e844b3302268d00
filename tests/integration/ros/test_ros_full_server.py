"""A ROS API with all its connections taken answers who comes with a request."""

from __future__ import annotations

import asyncio
import xmlrpc.client
from contextlib import AsyncExitStack

import pytest

from rce.ros.xmlrpc import Dispatcher, RpcServer, server

PATIENCE = 60.0
HEAD = b"POST / HTTP/1.1\r\nHost: a\r\nExpect: 100-continue\r\nContent-Length: 100\r\n\r\n"


def ask(proxy: xmlrpc.client.ServerProxy) -> object:
    return proxy.get("/a")


async def test_silent_connections_make_room_for_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that was not used for the longest time is closed, not one whose request is under way."""
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 10)
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        api = await enter(RpcServer(Dispatcher({"get": lambda _: (1, "", 0)}), "127.0.0.1"))
        await enter(asyncio.timeout(PATIENCE))
        busy_reader, busy = await begun(stack, api.port)
        used = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{api.port}/")
        stack.callback(used("close"))
        silent = []
        for _ in range(8):
            reader, writer = await asyncio.open_connection("127.0.0.1", api.port)
            stack.callback(writer.close)
            silent.append(reader)
        assert await asyncio.to_thread(ask, used) == [1, "", 0]
        for reader in silent[:3]:
            other = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{api.port}/")
            stack.callback(other("close"))
            assert await asyncio.to_thread(ask, other) == [1, "", 0]
            assert await closed(reader)
        assert await asyncio.to_thread(ask, used) == [1, "", 0]
        busy.write(b"x" * 100)
        assert b"HTTP/1.1 200" in await busy_reader.readuntil(b"200")


async def begun(stack: AsyncExitStack, port: int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Open a connection with a request that is under way."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    stack.callback(writer.close)
    writer.write(HEAD)
    assert (await reader.readline()).startswith(b"HTTP/1.1 100")
    return reader, writer


async def closed(reader: asyncio.StreamReader) -> bool:
    try:
        return await reader.read(1) == b""
    except ConnectionResetError:
        return True


async def test_one_more_request_is_turned_away_where_all_are_under_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 3)
    async with AsyncExitStack() as stack:
        api = await stack.enter_async_context(
            RpcServer(Dispatcher({"get": lambda _: (1, "", 0)}), "127.0.0.1")
        )
        await stack.enter_async_context(asyncio.timeout(PATIENCE))
        for _ in range(3):
            await begun(stack, api.port)
        reader, writer = await asyncio.open_connection("127.0.0.1", api.port)
        stack.callback(writer.close)
        assert await closed(reader)
