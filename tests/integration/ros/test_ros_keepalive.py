"""TCPROS connections ask a silent peer whether it is still there, as rospy's and roscpp's do."""

from __future__ import annotations

import asyncio
import socket

from rce.dialing import open_socket
from rce.ros.node.input_link import HeaderReader
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import SCRATCH_SIZE


class Open(Connection):
    """Shows its socket."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        sock = transport.get_extra_info("socket")
        self.options = [
            sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE),
            *(
                sock.getsockopt(socket.IPPROTO_TCP, option)
                for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
            ),
        ]


async def test_both_ends_ask_a_silent_peer() -> None:
    """An outage in which the end of the peer is lost does not leave a subscriber without messages."""
    loop = asyncio.get_running_loop()
    scratch = memoryview(bytearray(SCRATCH_SIZE))
    accepted: asyncio.Future[Open] = loop.create_future()

    def accept() -> Open:
        accepted.set_result(Open(HeaderReader(), scratch))
        return accepted.result()

    server = await loop.create_server(accept, "127.0.0.1", 0)
    async with server, asyncio.timeout(60):
        _, dialed = await loop.create_connection(
            lambda: Open(HeaderReader(), scratch), sock=await open_socket(*server.sockets[0].getsockname())
        )
        for connection in (dialed, await accepted):
            while not connection.is_open:
                await asyncio.sleep(0.005)
            assert connection.options == [1, 60, 10, 9]
        for connection in (dialed, accepted.result()):
            connection.abort()
            await connection.gone.wait()
