"""Programs between a client and a server, which disturb their connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

LOOPBACK = "127.0.0.1"


class GoBetween(ABC):
    """Listens on a port of its own; subclasses pass connections on by :meth:`connected`.

    Args:
        target: Host and port of the server.
        piece: Bytes that are read at once, and of the kernel's buffers; 0: the usual ones.
    """

    def __init__(self, target: tuple[str, int], piece: int = 0) -> None:
        self.target = target
        self._piece = piece
        self._port = 0
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def endpoint(self) -> str:
        """``host:port`` where it listens; the same after :meth:`open` was called again."""
        return f"{LOOPBACK}:{self._port}"

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[Self]:
        """Listen until this is left."""
        await self.open()
        try:
            yield self
        finally:
            await self.close()

    async def open(self) -> None:
        """Listen."""
        sock = socket.create_server((LOOPBACK, self._port))
        limit = 1 << 16
        if self._piece:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._piece)
            limit = self._piece
        self._server = await asyncio.start_server(self._serve, sock=sock, limit=limit)
        self._port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Refuse new connections, and break the others."""
        if self._server is None:
            return
        self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()
        self._server = None

    @abstractmethod
    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass on what a client sends and is sent, until either side ends the connection."""

    @contextlib.asynccontextmanager
    async def to_server(self) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
        """Connect to the server."""
        sock = socket.socket()
        try:
            sock.setblocking(False)
            if self._piece:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._piece)
            await asyncio.get_running_loop().sock_connect(sock, self.target)
            reader, writer = await asyncio.open_connection(sock=sock, limit=self._piece or 1 << 16)
        except BaseException:
            sock.close()
            raise
        try:
            yield reader, writer
        finally:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await self.connected(reader, writer)
        except* (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # one side ended the connection, or this ends; asyncio reports a cancelled handler
        finally:
            self._tasks.discard(task)
            writer.transport.abort()
