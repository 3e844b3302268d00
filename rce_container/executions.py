"""Connects commands in containers with the users who run them, through the master."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING

from websockets.exceptions import ConnectionClosed, WebSocketException

from rce.aio.tasks import run_until_first
from rce.control.execution import MAX_DATA, NOT_RUN, Command, ended_frame
from rce_container.exceptions import ExecutionError

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

    from rce.control import Execute
    from rce.control_channel.dialing import RunDialer

_log = logging.getLogger(__name__)

Start = Callable[[str, Command, socket.socket], None]
"""Hands a command and a socket to a container (by its endpoint id); raises ExecutionError."""


class Executions:
    """Carries the frames of runs between the master and environments without reading them.

    Args:
        dialer: Connects to the master.
        start: Gives a command to a container's environment.
    """

    def __init__(self, dialer: RunDialer, start: Start) -> None:
        self._dialer = dialer
        self._start = start
        self._leadership = ("", 0)
        """Name and term of the master that gives the orders."""
        self._running: dict[ClientConnection, tuple[str, int]] = {}
        """The leadership that ordered the run of each connection."""

    def welcomed(self, master: str, term: int) -> None:
        """End the runs that another leadership ordered.

        Its master ends their connections itself, unless it hangs or its machine is lost; then their users
        cannot end them.

        Args:
            master: The name of the master that leads now.
            term: Of its leadership.
        """
        self._leadership = (master, term)
        for connection, ordered_by in self._running.items():
            if ordered_by != self._leadership:
                _log.info("a command that master %s ordered is ended: %s leads", ordered_by[0], master)
                connection.transport.abort()

    async def execute(self, message: Execute) -> None:
        """Run a command to its end."""
        ordered_by = self._leadership
        try:
            async with self._dialer.dial(message.run) as master:
                if ordered_by != self._leadership:
                    return
                self._running[master] = ordered_by
                try:
                    await self._join(message, master)
                finally:
                    del self._running[master]
        except (OSError, TimeoutError, WebSocketException) as error:
            _log.warning("a command in %s is ended: %s", message.id, error)

    async def _join(self, message: Execute, master: ClientConnection) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        with ours:
            try:
                with theirs:
                    self._start(message.id, message.command, theirs)
            except ExecutionError as error:
                await master.send(ended_frame(NOT_RUN, str(error)).encode())
                return
            await _carry(ours, master)


async def _carry(sock: socket.socket, master: ClientConnection) -> None:
    """Carry frames both ways until either side disconnects."""
    loop = asyncio.get_running_loop()

    async def upwards() -> None:
        while frame := await loop.sock_recv(sock, MAX_DATA + 2):
            await master.send(frame)

    async def downwards() -> None:
        async for frame in master:
            if isinstance(frame, bytes) and frame:
                with contextlib.suppress(OSError):  # the command has ended; its last output is still carried
                    await loop.sock_sendall(sock, frame)

    with contextlib.suppress(ConnectionClosed, OSError):  # either side may disconnect at any time
        await run_until_first(upwards(), downwards())
