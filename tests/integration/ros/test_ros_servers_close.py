"""Servers of a node that close while a client connects."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING

import pytest

from rce.ros.tcpros.listener import Listener
from rce.ros.xmlrpc.dispatch import Dispatcher
from rce.ros.xmlrpc.server import RpcServer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.tcpros.connection import Connection


def _refuse(connection: Connection, fields: Mapping[str, str]) -> None:
    raise AssertionError((connection, fields))


def _server(kind: str) -> RpcServer | Listener:
    if kind == "xmlrpc":
        return RpcServer(Dispatcher({}), host="127.0.0.1")
    return Listener("127.0.0.1", memoryview(bytearray(1024)), topic=_refuse, service=_refuse)


@pytest.mark.parametrize("kind", ["xmlrpc", "tcpros"])
@pytest.mark.parametrize("steps", range(6))
async def test_client_that_connects_at_the_end_is_closed(kind: str, steps: int) -> None:
    """However far the event loop has come with accepting it when the server closes."""
    with socket.socket() as client:
        server = _server(kind)
        async with server:
            client.connect(("127.0.0.1", server.port))
            for _ in range(steps):
                await asyncio.sleep(0)
        client.setblocking(False)
        with contextlib.suppress(ConnectionResetError):
            assert await asyncio.wait_for(asyncio.get_running_loop().sock_recv(client, 1), 10) == b""
