"""TCPROS connections ask a silent peer whether it is still there, as rospy's and roscpp's do."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from rce.dialing import open_socket
from rce.ros.node.input_link import HeaderReader
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import SCRATCH_SIZE
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer


def options_of(sock: socket.socket) -> list[int]:
    """Return whether a socket is kept alive, and the seconds and number of questions."""
    return [
        sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE),
        *(
            sock.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        ),
    ]


def waits_to_ask(port: int) -> bool:
    """Return whether the system will ask the peer of a server's connection, by its table of connections."""
    rows = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
    (timer,) = (row[5] for row in rows if row[1] == f"0100007F:{port:04X}" and row[2] != "00000000:0000")
    return timer.startswith("02:")


class Open(Connection):
    """Shows its socket."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.options = options_of(transport.get_extra_info("socket"))


async def test_api_asks_a_silent_client() -> None:
    """Clients that lost their network would fill the table of a core's connections."""
    async with (
        RpcServer(Dispatcher({"get": lambda _: (1, "", 0)}), "127.0.0.1") as server,
        RpcClient() as rpc,
        asyncio.timeout(60),
    ):
        await rpc.call(f"http://127.0.0.1:{server.port}/", "get", ("/a",))
        while not waits_to_ask(server.port):  # until its answer is acknowledged
            await asyncio.sleep(0.01)


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
