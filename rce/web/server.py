"""An HTTP server as a context manager."""

from __future__ import annotations

from ssl import SSLContext
from typing import Self

from aiohttp import web
from yarl import URL

SHUTDOWN_S = 0.5
"""How long open requests may go on when the server ends."""


IDLE_S = 30.0
"""A connection that sends no request, or does not come to its end, for so long is closed."""


class HttpServer:
    """Serves an application. Use it as an asynchronous context manager.

    Attributes:
        url: Where it listens, once it does.
    """

    def __init__(
        self,
        app: web.Application,
        host: str,
        port: int,
        ssl: SSLContext | None = None,
        *,
        idle_timeout: float = IDLE_S,
    ) -> None:
        self._runner = web.AppRunner(
            app, access_log=None, shutdown_timeout=SHUTDOWN_S, keepalive_timeout=idle_timeout
        )
        self._host = host
        self._port = port
        self._ssl = ssl
        self.url = ""

    async def __aenter__(self) -> Self:
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, self._host, self._port, ssl_context=self._ssl).start()
        except BaseException:
            await self._runner.cleanup()
            raise
        port = self._runner.addresses[0][1]
        host = "127.0.0.1" if self._host in ("", "0.0.0.0", "::") else self._host  # noqa: S104 - compared, not bound
        self.url = str(URL.build(scheme="https" if self._ssl else "http", host=host, port=port, path="/"))
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._runner.cleanup()
