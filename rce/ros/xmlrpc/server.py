"""The HTTP server of a ROS API: h11 for the framing, a dispatcher for the answers.

The methods of ROS APIs only read or change state in memory, so a request is answered in the callback that
received its last byte: without a task or a queue, and in order on each connection.
"""

from __future__ import annotations

import asyncio
import logging
from http import HTTPStatus
from types import TracebackType
from typing import Self, cast

import h11

from rce.aio.servers import close_servers, open_server
from rce.dialing import set_keepalive
from rce.ros.closing import OpenConnections
from rce.ros.xmlrpc.batches import PRODUCT
from rce.ros.xmlrpc.dispatch import Dispatcher

_log = logging.getLogger(__name__)

MAX_BODY = 16 * 2**20
"""Longest request in bytes."""

MAX_CONNECTIONS = 4096
"""Open connections; for one more, that which was not used for the longest time is closed."""
REQUEST_TIMEOUT = 30.0
"""Seconds from a request's first byte to its last."""
_OF_BROWSERS = frozenset([b"origin", b"sec-fetch-site"])
"""Browsers send one of these with each POST, clients of ROS none: without it, any page could call a node."""


class RpcServer:
    """An XML-RPC server. An async context manager, listening inside its block.

    Attributes:
        port: The port taken.
    """

    def __init__(self, dispatcher: Dispatcher, host: str | None = None, port: int = 0) -> None:
        """Prepare a server.

        Args:
            dispatcher: Answers the calls.
            host: Address to listen on; ``None`` for all.
            port: 0 takes a free one.
        """
        self.port = port
        self._dispatcher = dispatcher
        self._host = host
        self._connections = OpenConnections[_Connection]()
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> Self:
        host = self._host or "0.0.0.0"  # noqa: S104 - nodes of other machines must reach it
        self._server = await open_server(self._accept, host, self.port, backlog=512)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            await close_servers([self._server])
        await self._connections.close()

    def _accept(self) -> _Connection:
        return _Connection(self._dispatcher, self._connections)


class _Connection(asyncio.Protocol):
    """One client's connection."""

    def __init__(self, dispatcher: Dispatcher, siblings: OpenConnections[_Connection]) -> None:
        self._dispatcher = dispatcher
        self._siblings = siblings
        self.gone = asyncio.Event()
        self._http = h11.Connection(h11.SERVER)
        self._body: list[bytes] = []
        self._size = 0
        self._transport: asyncio.Transport | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self._full = False
        self._is_head = False

    @property
    def is_idle(self) -> bool:
        """Whether no request is being received and all answers have been taken."""
        return self._deadline is None and not self._full

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's only behave like one
        if len(self._siblings) >= MAX_CONNECTIONS:
            unused = next((one for one in self._siblings if one.is_idle), self)
            _log.warning("more than %d connections: one of them is closed", MAX_CONNECTIONS)
            if unused is self:
                self._transport.abort()
                return
            self._siblings.discard(unused)
            unused.abort()
        set_keepalive(transport.get_extra_info("socket"), idle=60, interval=10, count=9)
        self._siblings.add(self)

    def connection_lost(self, error: Exception | None) -> None:
        del error  # a client may leave at any time
        self._transport = None
        self._siblings.discard(self)
        self._finish_request()
        self.gone.set()

    def data_received(self, data: bytes) -> None:
        if self._deadline is None:
            self._deadline = asyncio.get_running_loop().call_later(REQUEST_TIMEOUT, self.close)
        self._handle_events(data)

    def pause_writing(self) -> None:
        """Take no more requests: the client does not read its answers."""
        self._full = True
        if self._transport is not None and not self._is_closing():
            self._transport.pause_reading()

    def resume_writing(self) -> None:
        """Answer the requests that were read already, then take more."""
        self._full = False
        self._handle_events(b"")
        if self._transport is not None and not self._full and not self._is_closing():
            self._transport.resume_reading()

    def eof_received(self) -> None:
        """Close at once: a client that ends its side has got all its answers."""

    def close(self) -> None:
        """Close once the written data has been sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close now."""
        if self._transport is not None:
            self._transport.abort()

    def _handle_events(self, data: bytes) -> None:
        try:
            if data:  # h11 takes b"" for the end of the stream
                self._http.receive_data(data)
            while not self._full and not self._is_closing() and self._next_event():
                pass
        except h11.RemoteProtocolError as error:
            self._refuse(error.error_status_hint, str(error))

    def _next_event(self) -> bool:
        """Handle one event; return whether there may be more."""
        event = self._http.next_event()
        if event is h11.NEED_DATA or event is h11.PAUSED:
            if self._http.they_are_waiting_for_100_continue:
                self._send(h11.InformationalResponse(status_code=100, headers=[]))
            return False
        if isinstance(event, h11.Request):
            self._is_head = event.method == b"HEAD"
            if event.method != b"POST":
                self._refuse(405, "XML-RPC comes by POST")
            elif any(name in _OF_BROWSERS for name, _ in event.headers):
                self._refuse(403, "web pages may not use a ROS master or node")
        elif isinstance(event, h11.Data):
            self._size += len(event.data)
            if self._size > MAX_BODY:
                self._refuse(413, f"a request may have {MAX_BODY} bytes")
            self._body.append(bytes(event.data))
        elif isinstance(event, h11.EndOfMessage):
            self._answer()
        else:
            self.close()
            return False
        return True

    def _answer(self) -> None:
        document = self._dispatcher.respond(b"".join(self._body))
        self._finish_request()
        self._siblings.use(self)
        self._respond(200, b"text/xml", document)
        if self._http.our_state is h11.MUST_CLOSE:
            self.close()
        else:
            self._http.start_next_cycle()

    def _is_closing(self) -> bool:
        return self._transport is None or self._transport.is_closing()

    def _finish_request(self) -> None:
        self._body.clear()
        self._size = 0
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _refuse(self, status: int, reason: str) -> None:
        if self._http.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            self._respond(status, b"text/plain; charset=utf-8", reason.encode(), last=True)
        self.close()

    def _respond(self, status: int, kind: bytes, body: bytes, *, last: bool = False) -> None:
        # roscpp's parser is known to read this spelling of Content-length.
        headers = [(b"Content-type", kind), (b"Content-length", b"%d" % len(body)), (b"Server", PRODUCT)]
        if last:
            headers.append((b"Connection", b"close"))
        reason = HTTPStatus(status).phrase.encode()
        self._send(h11.Response(status_code=status, reason=reason, headers=headers))
        if not self._is_head:  # whose answer has no body
            self._send(h11.Data(data=body))
        self._send(h11.EndOfMessage())

    def _send(self, event: h11.Event) -> None:
        data = self._http.send(event)
        if data and self._transport is not None:
            self._transport.write(data)
