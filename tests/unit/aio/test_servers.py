"""A server that cannot listen leaves nothing open."""

from __future__ import annotations

import asyncio
import errno
import socket

import pytest

from rce.aio.servers import close_servers, open_server


async def test_a_port_lost_to_another_program_between_bind_and_listen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Linux binds both sockets and refuses the second that listens; an open one is a ResourceWarning."""
    listen = socket.socket.listen
    with socket.socket() as rival:
        rival.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        rival.bind(("127.0.0.1", 0))

        def too_late(self: socket.socket, backlog: int = 1) -> None:
            listen(rival)
            listen(self, backlog)

        monkeypatch.setattr(socket.socket, "listen", too_late)
        with pytest.raises(OSError, match=f"Errno {errno.EADDRINUSE}"):
            await open_server(asyncio.Protocol, "127.0.0.1", rival.getsockname()[1], backlog=1)


async def test_an_open_server_accepts() -> None:
    arrived = asyncio.Event()

    class Arrival(asyncio.Protocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            transport.close()
            arrived.set()

    server = await open_server(Arrival, "127.0.0.1", 0, backlog=1)
    try:
        _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        await asyncio.wait_for(arrived.wait(), 10)
        writer.close()
        await writer.wait_closed()
    finally:
        await close_servers([server])
