"""The XML-RPC client: one per process or node, keep-alive connections to every server it has called."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence
from http import HTTPStatus
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import h11

from rce.dialing import set_keepalive
from rce.ros.dialing import open_peer_socket
from rce.ros.errors import RpcRefusedError, RpcTimeoutError, RpcUnreachableError
from rce.ros.xmlrpc.codec import decode_response, encode_call

_log = logging.getLogger(__name__)

MAX_ANSWER = 64 * 2**20
"""Longest answer in bytes."""

MAX_IDLE = 4
"""How many idle connections are kept to one server."""

IDLE_TIME = 30.0
"""Seconds that an idle connection is kept."""

DEFAULT_TIMEOUT = 10.0

_CHUNK = 65536


class RpcClient:
    """Calls XML-RPC servers. An async context manager; leaving it closes the connections.

    Any number of calls may run at once; those to one server each take a connection of their own. It is kept
    for the next call until the server ends it, or for :data:`IDLE_TIME`: nodes come and go, each with ports
    of its own.
    """

    def __init__(self) -> None:
        self._idle: dict[tuple[str, int], list[_Connection]] = {}
        self._open: set[_Connection] = set()
        self._closed = False

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closed = True
        for connection in [one for idle in self._idle.values() for one in idle]:
            self._end_idleness(connection)
        for connection in list(self._open):
            await self._discard(connection)

    @property
    def connections(self) -> int:
        """How many connections it has now, idle ones among them."""
        return len(self._open)

    async def call(
        self, uri: str, method: str, arguments: Sequence[Any], *, timeout: float = DEFAULT_TIMEOUT
    ) -> Any:
        """Call ``method`` of the server at ``uri``.

        Cancelling a call closes its connection.

        Args:
            uri: ``http://host:port/``.
            method: The method's name.
            arguments: Values that XML-RPC can carry.
            timeout: Seconds for all of it.

        Raises:
            RpcUnreachableError: No answer came, for whatever reason; an RpcTimeoutError if none came in time,
                an RpcRefusedError if the connection was refused.
            RemoteFaultError: The server answered with a fault.
            MalformedDocumentError: An argument cannot be sent or the answer cannot be read.
        """
        return await self.send(uri, method, encode_call(method, arguments), timeout=timeout)

    async def send(self, uri: str, method: str, document: bytes, *, timeout: float = DEFAULT_TIMEOUT) -> Any:
        """Make a call from an encoded document, as :meth:`call` does.

        Args:
            uri: ``http://host:port/``.
            method: The method's name, for errors.
            document: The call, by :func:`~rce.ros.xmlrpc.codec.encode_call`.
            timeout: Seconds for all of it.

        Raises:
            RpcUnreachableError: No answer came, for whatever reason; an RpcTimeoutError if none came in time,
                an RpcRefusedError if the connection was refused.
            RemoteFaultError: The server answered with a fault.
            MalformedDocumentError: The answer cannot be read.
        """
        try:
            async with asyncio.timeout(timeout):
                answer = await self._exchange(uri, document)
        except TimeoutError as error:
            raise RpcTimeoutError(uri, f"{method} took longer than {timeout:g} s") from error
        except ConnectionRefusedError as error:
            raise RpcRefusedError(uri, str(error)) from error
        except (OSError, h11.ProtocolError, EOFError, ValueError) as error:
            raise RpcUnreachableError(uri, str(error) or type(error).__name__) from error
        return decode_response(answer)

    async def until_lost(self, uri: str) -> None:
        """Wait until the server at ``uri`` goes away: until a connection made for nothing else is lost.

        Raises:
            RpcUnreachableError: It is away already.
        """
        try:
            reader, writer = await asyncio.open_connection(sock=await open_peer_socket(*_address(uri)))
        except (OSError, ValueError) as error:
            raise RpcUnreachableError(uri, str(error)) from error
        set_keepalive(writer.get_extra_info("socket"), idle=10, interval=5, count=4)  # half a minute
        try:
            with contextlib.suppress(OSError):  # lost, whatever the reason
                await reader.read(1)
        finally:
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _exchange(self, uri: str, document: bytes) -> bytes:
        address = _address(uri)
        while (idle := self._take_idle(address)) is not None:
            try:
                return await self._post(idle, document)
            except (ConnectionError, EOFError, h11.RemoteProtocolError) as error:
                # The server closed the idle connection, as it may at any time. ROS calls may be repeated.
                _log.debug("reconnecting to %s: %s", uri, error)
        connection = await _Connection.open(*address, on_eof=self._drop_idle, on_lost=self._lost)
        self._open.add(connection)
        return await self._post(connection, document)

    async def _post(self, connection: _Connection, document: bytes) -> bytes:
        try:
            answer = await connection.post(document)
        except BaseException:
            await self._discard(connection)
            raise
        await self._give_back(connection)
        return answer

    async def _give_back(self, connection: _Connection) -> None:
        idle = self._idle.get(connection.address, [])
        if self._closed or not connection.reusable or len(idle) >= MAX_IDLE:
            await self._discard(connection)
            return
        self._idle[connection.address] = [*idle, connection]
        connection.idle_end = asyncio.get_running_loop().call_later(IDLE_TIME, self._drop_idle, connection)

    def _take_idle(self, address: tuple[str, int]) -> _Connection | None:
        idle = self._idle.get(address)
        if not idle:
            return None
        connection = idle[-1]
        self._end_idleness(connection)
        return connection

    def _end_idleness(self, connection: _Connection) -> bool:
        """Remove a connection from the idle ones; return whether it was one of them."""
        idle = self._idle.get(connection.address, [])
        if connection not in idle:
            return False
        idle.remove(connection)
        if not idle:
            del self._idle[connection.address]
        if connection.idle_end is not None:
            connection.idle_end.cancel()
        return True

    def _drop_idle(self, connection: _Connection) -> None:
        """Close a connection, if it is idle: its server has ended it, or its time is over."""
        if self._end_idleness(connection):
            connection.abort()

    def _lost(self, connection: _Connection) -> None:
        self._end_idleness(connection)
        self._open.discard(connection)

    async def _discard(self, connection: _Connection) -> None:
        self._open.discard(connection)
        await connection.close()


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


class _Connection:
    """One connection, used for one call at a time."""

    def __init__(
        self, address: tuple[str, int], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.address = address
        self.idle_end: asyncio.TimerHandle | None = None
        """Closes it, if it is still idle then."""
        self._reader = reader
        self._writer = writer
        self._http = h11.Connection(h11.CLIENT)

    @classmethod
    async def open(
        cls,
        host: str,
        port: int,
        *,
        on_eof: Callable[[_Connection], None],
        on_lost: Callable[[_Connection], None],
    ) -> _Connection:
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
            elif isinstance(event, h11.Data):
                body += event.data
                if len(body) > MAX_ANSWER:
                    raise ValueError(f"the answer is longer than {MAX_ANSWER} bytes")
            elif isinstance(event, h11.EndOfMessage):
                return bytes(body)


def _address(uri: str) -> tuple[str, int]:
    parts = urlsplit(uri)
    if parts.scheme != "http" or not parts.hostname or not parts.port:
        raise ValueError("not a URI of the form http://host:port/")
    return parts.hostname, parts.port
