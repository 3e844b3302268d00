"""A running application of aiohttp: the protocols of its connections, and their places in the lobby."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, cast

from aiohttp import web

from rce.web.faults import refuse_headers, request_log
from rce.web.writing import UnreadAnswers

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Awaitable, Callable, Iterator, Mapping

    from rce.guard import Guest

SHUTDOWN_S = 0.25
"""How long open requests may continue when the server ends; the library waits so long, and once more."""
_FIRST_ERROR = 400


class RunningApplication:
    """An application that serves connections.

    Args:
        app: The application.
        guests: The places of its connections in the lobby.
        idle_timeout: Seconds without a request after which a connection is closed.
    """

    def __init__(
        self, app: web.Application, guests: Mapping[asyncio.BaseTransport, Guest], idle_timeout: float
    ) -> None:
        self._guests = guests
        self._handled: set[Guest] = set()
        """Those whose request a handler works on."""
        self._unread = UnreadAnswers()
        app.middlewares.insert(0, self._track)
        app.on_response_prepare.append(self._grant)
        self._runner = web.AppRunner(
            app,
            access_log=None,
            logger=request_log,
            shutdown_timeout=SHUTDOWN_S,
            keepalive_timeout=idle_timeout,
            auto_decompress=False,
        )

    async def start(self) -> None:
        """Run the application's own preparations."""
        await self._runner.setup()
        assert self._runner.server is not None
        self._runner.server.request_handler = refuse_headers(self._runner.server.request_handler)

    async def close(self) -> None:
        """End all connections; open requests may continue for a moment."""
        await self._runner.cleanup()

    def make_protocol(self) -> asyncio.Protocol | None:
        """Return the protocol of a new connection; None once the application ends."""
        server = self._runner.server
        return None if server is None else cast("asyncio.Protocol", server())

    @web.middleware
    async def _track(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Keep a connection's place in the lobby while its request is handled; send the answer in time."""
        guest = None if request.transport is None else self._guests.get(request.transport)
        with nullcontext() if guest is None else self._handling(guest):
            response = await handler(request)
        if isinstance(response, web.Response) and not response.prepared:
            await self._unread.send(request, response)
        return response

    @contextmanager
    def _handling(self, guest: Guest) -> Iterator[None]:
        guest.speak()
        self._handled.add(guest)
        try:
            yield
        finally:
            self._handled.discard(guest)
            guest.rest()

    async def _grant(self, request: web.Request, response: web.StreamResponse) -> None:
        """Take note that a handler began to stream: the connection no longer counts as unauthenticated."""
        guest = None if request.transport is None else self._guests.get(request.transport)
        if guest in self._handled and response.status < _FIRST_ERROR:
            guest.leave()
