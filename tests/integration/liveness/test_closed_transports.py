"""Watching connections whose transport has closed the socket, before it tells that it is lost."""

from __future__ import annotations

import asyncio
from typing import cast

from rce.dialing import set_keepalive
from rce.liveness import Outflow


async def test_closed_transport_takes_nothing() -> None:
    async with await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0) as server:
        _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        outflow = Outflow(cast("asyncio.Transport", writer.transport))
        sock = writer.get_extra_info("socket")
        writer.write(b"x" * 1000)
        writer.transport.abort()
        assert not outflow.moved()
        while sock.fileno() >= 0:
            await asyncio.sleep(0)
        assert not outflow.moved()
        outflow.pinged()
        assert not outflow.moved()
        set_keepalive(sock, idle=60, interval=10, count=9)
