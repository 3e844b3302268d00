"""Closing many connections in an orderly way."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Protocol

CLOSE_TIMEOUT = 1.0
"""Seconds that peers get to take what was written before their connections are cut."""


class Closable(Protocol):
    """A connection that can be closed."""

    gone: asyncio.Event
    """Set when the socket is closed."""

    def close(self) -> None:
        """Close once what was written is out."""

    def abort(self) -> None:
        """Close now."""


async def close_all(connections: Iterable[Closable]) -> None:
    """Close connections and wait until their sockets are closed; those that take too long are cut."""
    pending = list(connections)
    for connection in pending:
        connection.close()
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT):
            for connection in pending:
                await connection.gone.wait()
    except TimeoutError:
        for connection in pending:
            connection.abort()
        for connection in pending:
            await connection.gone.wait()
