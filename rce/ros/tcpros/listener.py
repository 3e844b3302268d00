"""The listening side of TCPROS: one port for all topics and services of a node."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rce.aio.servers import close_servers, open_server
from rce.ros.closing import OpenConnections
from rce.ros.errors import HandshakeRefusedError
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.header import decode_header, encode_header

_log = logging.getLogger(__name__)

HEADER_TIMEOUT = 30.0
"""Seconds that a peer may take to send its header."""

Accept = Callable[[Connection, dict[str, str]], None]
"""Takes a connection over, given the peer's header: answers it and sets its owner, or refuses."""


class Listener:
    """Accepts connections and hands each to its topic or service. An async context manager.

    Attributes:
        port: The port taken.
    """

    def __init__(self, host: str, scratch: memoryview, *, topic: Accept, service: Accept) -> None:
        """Prepare a listener.

        Args:
            host: Address to listen on.
            scratch: Buffer shared by all connections.
            topic: Takes connections of subscribers.
            service: Takes connections of service clients.
        """
        self.port = 0
        self._host = host
        self._scratch = scratch
        self._topic = topic
        self._service = service
        self._connections = OpenConnections[Connection]()
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> Self:
        self._server = await open_server(self._accept, self._host, 0, backlog=512)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            await close_servers([self._server])
        await self._connections.close()

    def _accept(self) -> Connection:
        return Connection(_Greeter(self._topic, self._service), self._scratch, siblings=self._connections)


class _Greeter:
    """Owns a connection until its header came."""

    def __init__(self, topic: Accept, service: Accept) -> None:
        self._topic = topic
        self._service = service
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, connection: Connection) -> None:
        self._deadline = asyncio.get_running_loop().call_later(HEADER_TIMEOUT, connection.abort)

    def frame_received(self, connection: Connection, payload: bytes) -> None:
        self._stop_waiting()
        fields = decode_header(payload)
        try:
            if "service" in fields:
                self._service(connection, fields)
            elif "topic" in fields:
                self._topic(connection, fields)
            else:
                raise HandshakeRefusedError("the connection header names neither a topic nor a service")  # noqa: TRY301
        except HandshakeRefusedError as error:
            _log.warning("refused %s of %s: %s", connection, fields.get("callerid", "?"), error)
            connection.write((encode_header({"error": str(error)}),))
            connection.close()

    def connection_lost(self, connection: Connection, error: Exception | None) -> None:
        del connection, error  # the peer left before it sent its header
        self._stop_waiting()

    def writable(self, connection: Connection) -> None:
        """Do nothing: nothing waits to be written."""

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
