"""The WebSocket server that robots connect to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from websockets.asyncio.server import serve

from rce.guard.websocket import guarded
from rce_robot.session import Session
from rce_robot.websocket import RobotSocket

if TYPE_CHECKING:
    import socket

    from websockets.asyncio.server import Server, ServerConnection

    from rce.guard.lobby import Lobby
    from rce_robot.gate import Gate
    from rce_robot.settings import RobotSettings


def serve_robots(gate: Gate, settings: RobotSettings, listener: socket.socket, lobby: Lobby) -> Server:
    """Return the server, to be used with ``async with``.

    There is no compression: per-message deflate costs each message more time than it saves on any link but
    the slowest, and large messages (images, maps) are compressed already or go as binary values.
    """
    session = settings.session
    return serve(
        _run_session,
        sock=listener,
        process_request=gate.admit,
        create_connection=guarded(RobotSocket, lobby),
        compression=None,
        open_timeout=settings.open_timeout,
        ping_interval=session.ping_interval,
        ping_timeout=session.ping_timeout,
        close_timeout=session.close_timeout,
        max_size=session.max_message,
        write_limit=session.write_buffer,
    )


async def _run_session(connection: ServerConnection) -> None:
    assert isinstance(connection, RobotSocket)
    assert isinstance(connection.receiver, Session)
    await connection.receiver.run()
