"""One HTTP connection of an XML-RPC client, used for one request at a time."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from http import HTTPStatus

import h11

from rce.ros.dialing import open_peer_socket
from rce.ros.xmlrpc.batches import PRODUCT

MAX_ANSWER = 64 * 2**20
"""Longest answer in bytes."""

_CHUNK = 65536


class _Protocol(asyncio.StreamReaderProtocol):
    """Reports that the server ended its side, which a stream tells only those who read."""

    def __init__(self, reader: asyncio.StreamReader) -> None:
        super().__init__(reader)
        self.on_eof: Callable[[], None] = lambda: None
        self.on_lost: Callable[[], None] = lambda: None

    def eof_received(self) -> bool:
        stays_open = bool(super().eof_received())
        self.on_eof()
        return stays_open

    def connection_lost(self, error: Exception | None) -> None:
        super().connection_lost(error)
        self.on_lost()


class ClientConnection:
    """One connection, used for one request at a time.

    Attributes:
        address: Host and port of the server.
        idle_end: Closes it, if it is still idle then.
        takes_batches: Whether the server has said that it answers requests of several calls.
    """

    def __init__(
        self, address: tuple[str, int], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.address = address
        self.idle_end: asyncio.TimerHandle | None = None
        self.takes_batches = False
        self._reader = reader
        self._writer = writer
        self._http = h11.Connection(h11.CLIENT)

    @classmethod
    async def open(
        cls,
        host: str,
        port: int,
        *,
        on_eof: Callable[[ClientConnection], None],
        on_lost: Callable[[ClientConnection], None],
    ) -> ClientConnection:
        """Connect to a server.

        Args:
            host: Of the server.
            port: Of the server.
            on_eof: Called when the server ends its side.
            on_lost: Called when the connection is closed.
        """
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader()
        transport, protocol = await loop.create_connection(
            lambda: _Protocol(reader), sock=await open_peer_socket(host, port)
        )
        connection = cls((host, port), reader, asyncio.StreamWriter(transport, protocol, reader, loop))
        protocol.on_eof = lambda: on_eof(connection)
        protocol.on_lost = lambda: on_lost(connection)
        return connection

    @property
    def reusable(self) -> bool:
        """Whether another call may follow."""
        return self._http.our_state is h11.IDLE and not self._reader.at_eof()

    def abort(self) -> None:
        """Close at once."""
        self._writer.transport.abort()

    async def close(self) -> None:
        """Close at once and wait until it is closed."""
        self.abort()
        with contextlib.suppress(OSError):  # it may have been lost already, which counts as closed
            await self._writer.wait_closed()

    async def post(self, document: bytes) -> bytes:
        """Send a request and return the body of its answer.

        Raises:
            EOFError: The server closed the connection before an answer.
            ConnectionError: The connection was lost.
            h11.ProtocolError: The answer is not HTTP.
            ValueError: The answer has an HTTP status other than 200, or is longer than :data:`MAX_ANSWER`.
        """
        host, port = self.address
        request = h11.Request(
            method="POST",
            target="/RPC2",
            headers=[
                ("Host", f"{host}:{port}"),
                ("Content-type", "text/xml"),
                ("Content-length", str(len(document))),
            ],
        )
        parts = [self._http.send(request), self._http.send(h11.Data(data=document))]
        self._http.send(h11.EndOfMessage())
        self._writer.write(b"".join(part for part in parts if part))
        await self._writer.drain()
        body = await self._read_answer()
        if self._http.our_state is h11.DONE and self._http.their_state is h11.DONE:
            self._http.start_next_cycle()
        return body

    async def _read_answer(self) -> bytes:
        body = bytearray()
        while True:
            event = self._http.next_event()
            if event is h11.NEED_DATA:
                data = await self._reader.read(_CHUNK)
                if not data and self._http.their_state is h11.SEND_RESPONSE:
                    raise EOFError("the connection was closed before an answer")
                self._http.receive_data(data)
            elif isinstance(event, h11.Response):
                if event.status_code != HTTPStatus.OK:
                    raise ValueError(f"HTTP status {event.status_code}")
                self.takes_batches = (b"server", PRODUCT) in event.headers
            elif isinstance(event, h11.Data):
                body += event.data
                if len(body) > MAX_ANSWER:
                    raise ValueError(f"the answer is longer than {MAX_ANSWER} bytes")
            elif isinstance(event, h11.EndOfMessage):
                return bytes(body)
