"""A link with a limited rate between two programs."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

PIECE = 16 << 10


class SlowLink:
    """Passes connections on with a limited rate, in one direction or both.

    Attributes:
        hangs: Whether nothing is passed on, while the kernel still takes what comes.
    """

    def __init__(self, url: str, *, up: float = 0.0, down: float = 0.0) -> None:
        parts = urlsplit(url)
        assert parts.hostname is not None
        self._target = parts.hostname, parts.port or 80
        self._up, self._down = up, down
        self._tasks: set[asyncio.Task[None]] = set()
        self.hangs = False
        self.url = ""

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[SlowLink]:
        sock = socket.create_server(("127.0.0.1", 0))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, PIECE)  # so that little is on the way at a time
        server = await asyncio.start_server(self._serve, sock=sock, limit=PIECE)
        self.url = f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
        try:
            yield self
        finally:
            server.close()
            for task in tuple(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            await server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await self._link(reader, writer)
        except asyncio.CancelledError:
            pass  # at the end of the test; asyncio reports a handler that ends so
        finally:
            self._tasks.discard(task)
            writer.transport.abort()

    async def _link(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        sock = socket.create_connection(self._target)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, PIECE)
        there, to = await asyncio.open_connection(sock=sock, limit=PIECE)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._pass(reader, to, self._up))
                group.create_task(self._pass(there, writer, self._down))
        except* OSError:
            pass  # one of the two ended the connection
        finally:
            to.transport.abort()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, rate: float) -> None:
        while piece := await reader.read(PIECE):
            if rate:
                await asyncio.sleep(len(piece) / rate)
            while self.hangs:
                await asyncio.sleep(0.05)
            writer.write(piece)
            await writer.drain()
        raise ConnectionResetError
