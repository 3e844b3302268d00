"""WebSockets in TLS: servers that do the handshake first, and clients that report why a server hung up."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING, Any

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import InvalidHandshake

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from rce.tls.gate import TlsGate


class TlsClientConnection(ClientConnection):
    """A client's connection whose failed handshake names a TLS fault as its cause.

    In TLS 1.3 a client has done its part of the handshake before the server checks its certificate, so it
    learns of a refusal only when it waits for the answer to its first request.
    """

    _lost_by: Exception | None = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note of the reason."""
        self._lost_by = exc
        super().connection_lost(exc)

    async def handshake(self, *args: Any, **options: Any) -> None:
        """Do the opening handshake."""
        try:
            await super().handshake(*args, **options)
        except InvalidHandshake as error:
            if isinstance(self._lost_by, ssl.SSLError):
                raise error from self._lost_by
            raise


def behind_gate(kind: type[ServerConnection], gate: TlsGate | None) -> Any:
    """Return a factory of connections, for ``serve(create_connection=...)``; no gate means no TLS."""
    if gate is None:
        return kind

    def make(*args: Any, **options: Any) -> Any:
        return gate.guard(kind(*args, **options))

    return make
