"""The WebSocket server that robots connect to."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from websockets.asyncio.server import serve

from rce.guard import Lobby, TrustedProxies
from rce.guard.websocket import guarded
from rce.tls.gate import TlsGate
from rce.tls.websocket import behind_gate
from rce.web.origin import ServerNames
from rce_robot.doors.client.gate import Gate
from rce_robot.doors.client.session import Session
from rce_robot.doors.client.websocket import RobotSocket

if TYPE_CHECKING:
    import socket
    from collections.abc import AsyncIterator

    from websockets.asyncio.server import ServerConnection

    from rce.tls import Context
    from rce_robot.doors.base import Admission
    from rce_robot.settings import RobotSettings


class ClientDoor:
    """The door of the client protocol. Implements :class:`rce_robot.doors.base.Door`.

    Messages are not compressed: per-message deflate costs more time than it saves, except on the slowest
    links, and large messages (images, maps) are already compressed or go as binary values.

    Args:
        settings: The settings of the task set.
        listener: The socket to listen on.
        lobby: Counts connections that have not logged in.
        tls: Returns the TLS context for each connection; None for plain WebSockets.
    """

    def __init__(
        self, settings: RobotSettings, listener: socket.socket, lobby: Lobby, tls: Context | None = None
    ) -> None:
        self._settings = settings
        self._listener = listener
        self._lobby = lobby
        self._tls = tls

    @contextlib.asynccontextmanager
    async def opened(self, admission: Admission) -> AsyncIterator[None]:
        """Accept robots within the context."""
        settings, session = self._settings, self._settings.session
        proxies = TrustedProxies(settings.trusted_proxies)
        gate = Gate(admission, session, settings.origins, proxies, _names(settings))
        handshakes = None if self._tls is None else TlsGate("robots", self._tls, self._lobby)
        async with serve(
            _run_session,
            sock=self._listener,
            process_request=gate.admit,
            process_response=gate.answer,
            create_connection=behind_gate(guarded(RobotSocket, self._lobby), handshakes),
            compression=None,
            open_timeout=settings.open_timeout,
            ping_interval=None,  # Session.run starts a watch of its own
            close_timeout=session.close_timeout,
            max_size=session.max_message,
            write_limit=session.write_buffer,
        ):
            try:
                yield
            finally:
                if handshakes is not None:
                    await handshakes.close()


def _names(settings: RobotSettings) -> ServerNames:
    """Return the host names of the endpoint."""
    public = urlsplit(settings.public_url).hostname or ""
    return ServerNames(settings.host, (settings.public_host, public))


async def _run_session(connection: ServerConnection) -> None:
    assert isinstance(connection, RobotSocket)
    assert isinstance(connection.receiver, Session)
    await connection.receiver.run()
