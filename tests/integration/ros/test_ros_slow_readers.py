"""Clients that send many requests and read the answers late: a server keeps only a few answers for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

import pytest
from support.ros_nodes import MakeNode

from rce.ros.node import Service
from rce.ros.tcpros.connection import WRITE_HIGH
from rce.ros.tcpros.framing import frame
from rce.ros.tcpros.header import encode_header
from rce.ros.xmlrpc import Dispatcher, RpcServer
from rce.ros.xmlrpc.codec import encode_call

ANSWER = b"x" * 65_000
REQUESTS = 400


def unsent(transports: Iterable[asyncio.Transport | None]) -> int:
    """Return how many bytes of answers wait in these transports."""
    return sum(transport.get_write_buffer_size() for transport in transports if transport is not None)


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.005)


@pytest.mark.parametrize("waits", [False, True])
async def test_service_keeps_few_answers(make_node: MakeNode, waits: bool) -> None:
    seen: list[int] = []
    services: list[Service] = []

    def waiting() -> int:
        return unsent(session.connection._transport for one in services for session in one._sessions)

    def handle(_: bytes) -> bytes:
        seen.append(waiting())
        return ANSWER

    async def handle_later(request: bytes) -> bytes:
        return handle(request)

    async with make_node("a") as node, asyncio.timeout(60):
        handler = handle_later if waits else handle
        services.append(await node.advertise_service_serialized("s", "std_srvs/Empty", handler))
        reader, writer = await asyncio.open_connection("127.0.0.1", int(node.service_uri.rpartition(":")[2]))
        header = {"callerid": "/b", "service": "/s", "md5sum": "*", "persistent": "1"}
        writer.write(encode_header(header) + b"".join(frame(b"")) * REQUESTS)
        await until(lambda: waiting() > 0)
        await reader.readexactly(int.from_bytes(await reader.readexactly(4), "little"))
        for _ in range(REQUESTS):
            ok, length = await reader.readexactly(1), int.from_bytes(await reader.readexactly(4), "little")
            assert (ok, length) == (b"\x01", len(ANSWER))
            await reader.readexactly(length)
        writer.close()
        await writer.wait_closed()
    assert len(seen) == REQUESTS
    assert max(seen) <= WRITE_HIGH


async def test_api_keeps_few_answers() -> None:
    seen: list[int] = []

    def get(_: str) -> tuple[int, str, str]:
        seen.append(waiting())
        return 1, "", ANSWER.decode()

    async with RpcServer(Dispatcher({"get": get}), "127.0.0.1") as server, asyncio.timeout(60):

        def waiting() -> int:
            return unsent(connection._transport for connection in server._connections._connections)

        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        document = encode_call("get", ("/a",))
        head = b"POST /RPC2 HTTP/1.1\r\nHost: a\r\nContent-Length: %d\r\n\r\n" % len(document)
        writer.write((head + document) * REQUESTS)
        await until(lambda: waiting() > 0)
        for _ in range(REQUESTS):
            answer = await reader.readuntil(b"\r\n\r\n")
            assert answer.startswith(b"HTTP/1.1 200")
            await reader.readexactly(int(answer.lower().partition(b"content-length: ")[2].split()[0]))
        writer.close()
        await writer.wait_closed()
    assert len(seen) == REQUESTS
    assert max(seen) <= WRITE_HIGH
