"""Orderly closing: handles of a node, and many connections at once."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from typing import Protocol

from rce.ros.errors import MasterError

CLOSE_TIMEOUT = 1.0
"""Seconds that peers may take to read written data before their connections are aborted."""


class Closable(Protocol):
    """A connection that can be closed."""

    gone: asyncio.Event
    """Set when the socket is closed."""

    def close(self) -> None:
        """Close once the written data has been sent."""

    def abort(self) -> None:
        """Close now."""


async def close_all(connections: Iterable[Closable]) -> None:
    """Close connections and wait until their sockets are closed; abort those that take too long."""
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


_log = logging.getLogger(__name__)


class Handle(Protocol):
    """A publisher, subscriber or service of a node."""

    async def close(self) -> None:
        """Close the handle."""


async def release(handle: Handle) -> None:
    """Close a handle at the end of a block; ignore it if the master cannot be reached any more."""
    try:
        await handle.close()
    except MasterError as error:
        _log.info("closed without telling the master: %s", error)
