"""An HTTP server as a context manager."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self, cast

from rce.aio.servers import close_servers, open_server
from rce.aio.tasks import BackgroundTasks, finish
from rce.guard import Guest, Lobby, address_of
from rce.guard.plain import PlainPort
from rce.tls.gate import TlsGate
from rce.web.early import EarlyConnection

if TYPE_CHECKING:
    from collections.abc import Callable

    from aiohttp import web

    from rce.tls import Context
    from rce.web.entry import EntryAnswer
    from rce.web.serving import RunningApplication

IDLE_S = 30.0
"""A connection that sends no request, or does not come to its end, for so long is closed."""

_BACKLOG = 512
_SWEEP_EVERY = 32
"""Connections after which those that have ended are forgotten."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LateApplication:
    """An application that is loaded with the first request that is not for the entry of its server."""

    load: Callable[[], Callable[[], web.Application]]
    """Imports what the application needs, in a thread; returns what makes it, in the event loop."""
    entry: Callable[[str], EntryAnswer]
    """Answers ``GET /`` until then, from the query of the request."""


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
        app: web.Application | LateApplication,
        host: str,
        port: int,
        tls: Context | None = None,
        *,
        idle_timeout: float = IDLE_S,
        lobby: Lobby | None = None,
    ) -> None:
        self.lobby = Lobby("HTTP") if lobby is None else lobby
        self._guests: dict[asyncio.BaseTransport, Guest] = {}
        self._arrivals = 0
        self._app = app
        self._idle_timeout = idle_timeout
        self._running: RunningApplication | None = None
        self._loading = BackgroundTasks()
        self._is_loading = False
        self._early: set[EarlyConnection] = set()
        """Connections without the application."""
        self._host = host
        self._port = port
        self._gate = None if tls is None else TlsGate("HTTPS", tls, self.lobby)
        self._plain = PlainPort("HTTP") if tls is None else None
        self._server: asyncio.Server | None = None
        self.url = ""

    async def __aenter__(self) -> Self:
        if not isinstance(self._app, LateApplication):
            self._running = await self._start(self._app)
        try:
            self._server = await open_server(
                self._make_arrival, self._host or None, self._port, backlog=_BACKLOG
            )
        except BaseException:
            await self._end_application()
            raise
        port = self._server.sockets[0].getsockname()[1]
        host = "127.0.0.1" if self._host in ("", "0.0.0.0", "::") else self._host  # noqa: S104 - compared, not bound
        scheme = "http" if self._gate is None else "https"
        self.url = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"
        return self

    async def __aexit__(self, *_: object) -> None:
        # To its end: several parts of a program may each cancel it when they fail at the same time, and a
        # connection that stayed open would be answered by an application that has ended.
        await finish(self._close())

    async def _close(self) -> None:
        assert self._server is not None
        await close_servers([self._server])
        if self._gate is not None:
            await self._gate.close()
        await self._end_application()
        # aiohttp leaves one open that came while it waited for the others: its client would be answered by an
        # application that has ended, for as long as it sends requests.
        for transport in self._guests:
            if not transport.is_closing():
                cast("asyncio.Transport", transport).abort()
        await self._server.wait_closed()

    # The application

    async def _start(self, app: web.Application) -> RunningApplication:
        from rce.web.serving import RunningApplication  # loads aiohttp

        running = RunningApplication(app, self._guests, self._idle_timeout)
        await running.start()
        return running

    async def _load(self, late: LateApplication) -> None:
        """Start the application, and give it the connections that wait for it."""
        try:
            make = await asyncio.to_thread(late.load)  # robots and task sets do not wait for it
            self._running = await self._start(make())
        except Exception:  # noqa: BLE001 - the next request tries again
            _log.exception("the application cannot be loaded; its clients are sent away")
        finally:
            self._is_loading = False
            for early in [early for early in self._early if early.waits]:
                self._pass_on(early)

    async def _end_application(self) -> None:
        await self._loading.close()
        for early in tuple(self._early):
            early.close()
        if self._running is not None:
            await self._running.close()

    def _want_application(self, early: EarlyConnection) -> None:
        """Give a connection to the application, once this is loaded."""
        if self._running is not None:
            self._pass_on(early)
        elif not self._loading.closed and not self._is_loading:
            assert isinstance(self._app, LateApplication)
            self._is_loading = True
            self._loading.spawn(self._load(self._app), name="load the application")

    def _pass_on(self, early: EarlyConnection) -> None:
        protocol = None if self._running is None else self._running.make_protocol()
        if protocol is None:
            early.close()
        else:
            early.pass_on(protocol)

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
        if guest is None:
            transport.abort()
            return
        self._guests[transport] = guest
        if self._running is None:
            assert isinstance(self._app, LateApplication)
            entry = self._app.entry
            early = EarlyConnection(entry, self._want_application, self._early, self._idle_timeout)
            protocol: asyncio.Protocol | None = early
        else:
            protocol = self._running.make_protocol()
        if protocol is None:
            transport.abort()
            return
        transport.set_protocol(
            protocol if self._plain is None else _FirstWords(self._plain, protocol, transport)
        )
        protocol.connection_made(transport)

    def _forget_ended(self) -> None:
        for transport in [transport for transport in self._guests if transport.is_closing()]:
            self._guests.pop(transport).leave()


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
