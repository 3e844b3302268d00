"""The connections that an XML-RPC client keeps: for the next call, not for servers that have ended."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

import pytest
from support.ports import free_port

from rce.dialing import connect_first
from rce.ros.errors import RpcRefusedError
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer, client


def server() -> RpcServer:
    return RpcServer(Dispatcher({"get": lambda _: (1, "", 0)}), "127.0.0.1")


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.005)


async def test_no_connection_stays_of_servers_that_ended() -> None:
    """A core calls every node that was ever started, each on a port of its own."""
    async with RpcClient() as rpc:
        for _ in range(50):
            async with server() as one:
                assert (await rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",)))[0] == 1
        await until(lambda: rpc.connections == 0)


async def test_idle_connection_is_kept_for_the_next_call() -> None:
    async with RpcClient() as rpc, server() as one:
        for _ in range(10):
            await rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",))
            assert rpc.connections == 1


async def test_idle_connection_is_closed_after_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "IDLE_TIME", 0.05)
    async with RpcClient() as rpc, server() as one:
        for _ in range(3):
            await asyncio.gather(
                *(rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",)) for _ in range(10))
            )
            await until(lambda: rpc.connections == 0)


async def test_burst_leaves_few_idle_connections() -> None:
    async with RpcClient() as rpc, server() as one:
        await asyncio.gather(*(rpc.call(f"http://127.0.0.1:{one.port}/", "get", ("/a",)) for _ in range(40)))
        assert rpc.connections <= client.MAX_IDLE


async def test_refused_call_is_told_from_a_lost_one() -> None:
    async with RpcClient() as rpc:
        with pytest.raises(RpcRefusedError):
            await rpc.call(f"http://127.0.0.1:{free_port()}/", "get", ("/a",))


async def test_host_of_two_addresses_that_refuse_refuses() -> None:
    port = free_port()
    with pytest.raises(ConnectionRefusedError, match="; "):
        await connect_first([(socket.AF_INET, (f"127.0.0.{host}", port)) for host in (1, 2)])
