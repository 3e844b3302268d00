"""Orderly closing: handles of a node, and many connections at once."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Iterable, Iterator
from typing import Any, Generic, Protocol, TypeVar

from rce.aio.tasks import cancel_and_wait
from rce.ros.errors import MasterError, MasterUnreachableError

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


C = TypeVar("C", bound=Closable)


class OpenConnections(Generic[C]):
    """The open connections of one server, in the order of their last use."""

    def __init__(self) -> None:
        self._connections: dict[C, None] = {}
        self._closed = False

    def __len__(self) -> int:
        return len(self._connections)

    def __iter__(self) -> Iterator[C]:
        return iter(self._connections)

    def add(self, connection: C) -> None:
        """Note an open connection; abort it if the server closed while the connection was accepted."""
        if self._closed:
            connection.abort()
        else:
            self._connections[connection] = None

    def use(self, connection: C) -> None:
        """Note that an open connection was used."""
        if self._connections.pop(connection, self) is None:
            self._connections[connection] = None

    def discard(self, connection: C) -> None:
        """Forget a connection whose socket is closed."""
        self._connections.pop(connection, None)

    async def close(self) -> None:
        """Close all and wait until their sockets are closed; abort those that take too long."""
        self._closed = True
        pending = list(self._connections)
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

    def close(self) -> Coroutine[Any, Any, None]:
        """Close the handle, then tell the master."""


async def release(handle: Handle) -> None:
    """Close a handle at the end of a block; ignore it if the master cannot be reached any more."""
    try:
        await handle.close()
    except MasterError as error:
        _log.info("closed without telling the master: %s", error)


async def release_all(handles: Iterable[Handle]) -> None:
    """Close handles one after the other, as :func:`release` does.

    A master that hangs is waited for once, not for each handle: the others are closed without telling it.
    """
    is_reachable = True
    for handle in handles:
        if is_reachable:
            try:
                await handle.close()
            except MasterError as error:
                _log.info("closed without telling the master: %s", error)
                is_reachable = not isinstance(error, MasterUnreachableError)
        else:
            closing = asyncio.create_task(handle.close())
            await asyncio.sleep(0)  # its first step closes the handle and begins to tell the master
            await cancel_and_wait(closing)
