"""Masters that answer nothing: one that hangs, one whose machine is off, and one that a task set misses."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from rce.control.exceptions import ControlError
    from rce.control.messages import ClientReply, LoginReply, ToMaster
    from rce.model import Request

_FILLED_AFTER = 8
"""Connections that surely fill the shortest queue of a listening socket."""


@contextlib.asynccontextmanager
async def silent_master() -> AsyncIterator[tuple[str, asyncio.Event]]:
    """Give the address of a master that answers nothing, and what is set when it has got a request."""
    asked = asyncio.Event()

    async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError):
            await reader.readuntil(b"\r\n\r\n")
            asked.set()
            await reader.read()
        writer.transport.abort()

    server = await asyncio.start_server(take, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/", asked
    finally:
        server.close()


@contextlib.asynccontextmanager
async def counted_standby(scheme: str = "ws") -> AsyncIterator[tuple[str, list[int]]]:
    """Give the address of what closes each connection at once, and the numbers of those that came."""
    dialed: list[int] = []

    async def close(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        dialed.append(len(dialed))
        writer.transport.abort()

    server = await asyncio.start_server(close, "127.0.0.1", 0)
    try:
        yield f"{scheme}://127.0.0.1:{server.sockets[0].getsockname()[1]}", dialed
    finally:
        server.close()


@contextlib.contextmanager
def unreachable_port() -> Iterator[int]:
    """Give a port of this machine to which no connection can be made, nor is one refused.

    Its queue is full, so the system drops what asks for a connection, as a firewall does.
    """
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(_FILLED_AFTER):
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                waiting.connect(listener.getsockname())
        yield listener.getsockname()[1]


class FailingChannel:
    """A channel on which each request fails with an error."""

    def __init__(self, error: ControlError) -> None:
        self.error = error

    def send(self, message: ToMaster) -> None:
        raise AssertionError(message)

    async def login(
        self, user: str, robot: str, password: str, address: str = "", token: str = ""
    ) -> LoginReply:
        raise self.error

    async def client_request(
        self,
        id: str,  # noqa: A002 - wire names
        type: str,  # noqa: A002
        data: object = None,
        *,
        content: Request | None = None,
    ) -> ClientReply:
        raise self.error
