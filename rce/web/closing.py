"""The end of a WebSocket whose other side may take nothing."""

from __future__ import annotations

import asyncio

from aiohttp import WSCloseCode, web

CLOSE_S = 10.0
"""How long the other side has to take a last message, and to answer the close."""


async def close_socket(
    request: web.Request,
    socket: web.WebSocketResponse,
    *,
    last: str | bytes | None = None,
    code: int = WSCloseCode.OK,
    reason: str = "",
) -> None:
    """Close a WebSocket; return when it has ended, after :data:`CLOSE_S` at the latest.

    The library waits without a limit until the other side takes data. Nothing happens if the other side has
    left already.

    Args:
        request: The request that opened it.
        socket: The WebSocket.
        last: A message to send before.
        code: Of the close frame.
        reason: Of the close frame; at most 123 bytes.
    """
    transport = request.transport
    try:
        async with asyncio.timeout(CLOSE_S):
            if isinstance(last, str):
                await socket.send_str(last)
            elif last is not None:
                await socket.send_bytes(last)
            await socket.close(code=code, message=reason.encode())
    except ConnectionError:
        return
    except (TimeoutError, asyncio.CancelledError):
        if transport is not None:
            transport.abort()
        # A send that was cancelled while it waited leaves the library a cancelled future, and the next one
        # waits for that.
        if (task := asyncio.current_task()) is not None and task.cancelling():
            raise
