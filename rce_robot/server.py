"""The WebSocket server that robots connect to."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from websockets.asyncio.server import serve

from rce.guard.websocket import guarded
from rce.tls.gate import TlsGate
from rce.tls.websocket import behind_gate
from rce_robot.session import Session
from rce_robot.websocket import RobotSocket

if TYPE_CHECKING:
    import socket
    from collections.abc import AsyncIterator

    from websockets.asyncio.server import Server, ServerConnection

    from rce.guard.lobby import Lobby
    from rce.tls.identity import Context
    from rce_robot.gate import Gate
    from rce_robot.settings import RobotSettings


@contextlib.asynccontextmanager
async def serve_robots(
    gate: Gate,
    settings: RobotSettings,
    listener: socket.socket,
    lobby: Lobby,
    tls: Context | None = None,
) -> AsyncIterator[Server]:
    """Serve robots within the context.

    Args:
        gate: Says which robots may come in.
        settings: What was set.
        listener: The socket to listen on.
        lobby: Where connections are counted that have not logged in.
        tls: Gives the TLS context for each connection; none for plain WebSockets.

    There is no compression: per-message deflate costs each message more time than it saves on any link but
    the slowest, and large messages (images, maps) are compressed already or go as binary values.
    """
    session = settings.session
    handshakes = None if tls is None else TlsGate("robots", tls, lobby)
    async with serve(
        _run_session,
        sock=listener,
        process_request=gate.admit,
        process_response=gate.answer,
        create_connection=behind_gate(guarded(RobotSocket, lobby), handshakes),
        compression=None,
        open_timeout=settings.open_timeout,
        ping_interval=session.ping_interval,
        ping_timeout=session.ping_timeout,
        close_timeout=session.close_timeout,
        max_size=session.max_message,
        write_limit=session.write_buffer,
    ) as server:
        try:
            yield server
        finally:
            if handshakes is not None:
                await handshakes.close()


async def _run_session(connection: ServerConnection) -> None:
    assert isinstance(connection, RobotSocket)
    assert isinstance(connection.receiver, Session)
    await connection.receiver.run()
