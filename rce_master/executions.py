"""Connects users who run commands in containers with the task sets that dial for them."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections import Counter
from typing import TYPE_CHECKING

from websockets.exceptions import ConnectionClosed

from rce.control import Execute
from rce.control.execution import FEATURE, Command
from rce_master.exceptions import LimitReachedError, TaskSetAwayError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from websockets.asyncio.server import ServerConnection

    from rce_master.reconciler import Peer

DIAL_S = 10.0
"""Seconds that a task set may take to dial."""
PER_USER = 32
"""Commands of one user that may run at the same time."""


class _Waiting:
    """A run whose task set has not dialed yet, or is being served."""

    def __init__(self) -> None:
        self.arrived: asyncio.Future[ServerConnection] = asyncio.get_running_loop().create_future()
        self.finished = asyncio.Event()


class Executions:
    """The runs of all users."""

    def __init__(self) -> None:
        self._waiting: dict[str, _Waiting] = {}
        self._running: Counter[str] = Counter()

    @contextlib.asynccontextmanager
    async def open(self, peer: Peer, id_: str, command: Command) -> AsyncIterator[ServerConnection]:
        """Have a task set run a command; provide the connection that carries the run's frames.

        Args:
            peer: The container's task set.
            id_: Endpoint id of the container.
            command: What to run.

        Raises:
            LimitReachedError: The container's user runs too many commands already.
            TaskSetAwayError: The task set does not support it, or did not dial in time.
        """
        tag = id_.partition("/")[2]
        if FEATURE not in peer.features:
            raise TaskSetAwayError(
                f"the machine of container {tag!r} runs an earlier release, which runs no commands"
            )
        user = id_.partition("/")[0]
        if self._running[user] >= PER_USER:
            raise LimitReachedError(f"user {user!r} runs {PER_USER} commands already; end one of them")
        run = secrets.token_hex(16)
        waiting = self._waiting[run] = _Waiting()
        self._running[user] += 1
        try:
            peer.send(Execute(id=id_, run=run, command=command))
            try:
                async with asyncio.timeout(DIAL_S):
                    socket = await waiting.arrived
            except TimeoutError as error:
                raise TaskSetAwayError(f"the machine of container {tag!r} does not answer") from error
            yield socket
        finally:
            waiting.finished.set()
            del self._waiting[run]
            self._running[user] -= 1
            if not self._running[user]:
                del self._running[user]

    async def arrived(self, run: str, socket: ServerConnection) -> None:
        """Handle a connection that a task set dialed; return when the run has ended (for the server)."""
        waiting = self._waiting.get(run)
        if waiting is None or waiting.arrived.done():
            return
        waiting.arrived.set_result(socket)
        await waiting.finished.wait()
        with contextlib.suppress(ConnectionClosed):
            await socket.close()
