"""An HTTP server as a context manager."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Self, cast

from aiohttp import web
from yarl import URL

from rce.aio.servers import close_servers
from rce.guard.lobby import Guest, Lobby, address_of
from rce.guard.plain import PlainPort
from rce.tls.gate import TlsGate
from rce.web.faults import refuse_expectations, request_log

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce.tls.identity import Context

SHUTDOWN_S = 0.5
"""How long open requests may continue when the server ends."""
IDLE_S = 30.0
"""A connection that sends no request, or does not come to its end, for so long is closed."""

_BACKLOG = 512
_FIRST_ERROR = 400
_SWEEP_EVERY = 32
"""Connections after which those that have ended are forgotten."""


class HttpServer:
    """Serves an application. Use it as an asynchronous context manager.

    A connection without an answer counts as unauthenticated, also between requests; one with an accepted
    stream does not. When there are too many, those without a request are closed first.

    Args:
        app: The application.
        host: Address to listen on; empty for all.
        port: 0 takes a free one.
        tls: Gives the TLS context for each connection; none serves plain HTTP.
        idle_timeout: Seconds without a request after which a connection is closed.
        lobby: Counts unauthenticated connections; one of its own if none.

    Attributes:
        url: The URL of the server, once it listens.
        lobby: The unauthenticated connections.
    """

    def __init__(
        self,
        app: web.Application,
        host: str,
        port: int,
        tls: Context | None = None,
        *,
        idle_timeout: float = IDLE_S,
        lobby: Lobby | None = None,
    ) -> None:
        self.lobby = Lobby("HTTP") if lobby is None else lobby
        self._guests: dict[asyncio.BaseTransport, Guest] = {}
        self._handled: set[Guest] = set()
        """Those whose request a handler works on."""
        self._arrivals = 0
        app.middlewares.insert(0, self._track)
        app.on_response_prepare.append(self._grant)
        self._runner = web.AppRunner(
            app,
            access_log=None,
            logger=request_log,
            shutdown_timeout=SHUTDOWN_S,
            keepalive_timeout=idle_timeout,
        )
        self._host = host
        self._port = port
        self._gate = None if tls is None else TlsGate("HTTPS", tls, self.lobby)
        self._plain = PlainPort("HTTP") if tls is None else None
        self._server: asyncio.Server | None = None
        self.url = ""

    async def __aenter__(self) -> Self:
        await self._runner.setup()
        assert self._runner.server is not None
        self._runner.server.request_handler = refuse_expectations(self._runner.server.request_handler)
        try:
            self._server = await asyncio.get_running_loop().create_server(
                self._make_arrival, self._host or None, self._port, backlog=_BACKLOG
            )
        except BaseException:
            await self._runner.cleanup()
            raise
        port = self._server.sockets[0].getsockname()[1]
        host = "127.0.0.1" if self._host in ("", "0.0.0.0", "::") else self._host  # noqa: S104 - compared, not bound
        scheme = "http" if self._gate is None else "https"
        self.url = str(URL.build(scheme=scheme, host=host, port=port, path="/"))
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        await close_servers([self._server])
        if self._gate is not None:
            await self._gate.close()
        await self._runner.cleanup()
        await self._server.wait_closed()

    # Connections

    def _make_arrival(self) -> asyncio.Protocol:
        arrival = _Arrival(self._admit)
        return arrival if self._gate is None else self._gate.guard(arrival)

    def _admit(self, transport: asyncio.Transport) -> None:
        """Serve a new connection, if there is room for it."""
        self._arrivals += 1
        if self._arrivals % _SWEEP_EVERY == 0:
            self._forget_ended()
        guest = self.lobby.enter(address_of(transport.get_extra_info("peername")), transport.abort)
        if guest is None or self._runner.server is None:
            transport.abort()
            return
        self._guests[transport] = guest
        protocol = cast("asyncio.Protocol", self._runner.server())
        transport.set_protocol(
            protocol if self._plain is None else _FirstWords(self._plain, protocol, transport)
        )
        protocol.connection_made(transport)

    def _forget_ended(self) -> None:
        for transport in [transport for transport in self._guests if transport.is_closing()]:
            self._guests.pop(transport).leave()

    @web.middleware
    async def _track(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Keep a connection's place in the lobby while its request is handled."""
        guest = None if request.transport is None else self._guests.get(request.transport)
        if guest is None:
            return await handler(request)
        guest.speak()
        self._handled.add(guest)
        try:
            return await handler(request)
        finally:
            self._handled.discard(guest)
            guest.rest()

    async def _grant(self, request: web.Request, response: web.StreamResponse) -> None:
        """Take note that a handler began to stream: the connection no longer counts as unauthenticated."""
        guest = None if request.transport is None else self._guests.get(request.transport)
        if guest in self._handled and response.status < _FIRST_ERROR:
            guest.leave()


class _Arrival(asyncio.Protocol):
    """A connection's protocol until it is let in."""

    def __init__(self, admit: Callable[[asyncio.Transport], None]) -> None:
        self._admit = admit

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._admit(cast("asyncio.Transport", transport))


class _FirstWords(asyncio.Protocol):
    """A plain connection's protocol until its first bytes, which may be those of a TLS client."""

    def __init__(self, port: PlainPort, protocol: asyncio.Protocol, transport: asyncio.Transport) -> None:
        self._port = port
        self._protocol = protocol
        self._transport = transport
        self.pause_writing = protocol.pause_writing  # type: ignore[method-assign] # passed on as they are
        self.resume_writing = protocol.resume_writing  # type: ignore[method-assign]
        self.eof_received = protocol.eof_received  # type: ignore[method-assign]
        self.connection_lost = protocol.connection_lost  # type: ignore[method-assign]

    def data_received(self, data: bytes) -> None:
        if not self._port.refuses(self._transport, data, asyncio.get_running_loop().time()):
            self._transport.set_protocol(self._protocol)
            self._protocol.data_received(data)
