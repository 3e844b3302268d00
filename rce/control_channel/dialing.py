"""A task set's connections to the master beside the control channel: for runs, and to send snapshots."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from websockets.asyncio.client import connect

from rce.control.execution import MAX_DATA, path_of
from rce.control_channel.connections import OpenConnections
from rce.control_channel.timeouts import DEFAULT_TIMEOUTS, ControlTimeouts
from rce.dialing import open_url_socket
from rce.liveness.websocket import WatchedConnection
from rce.tls.websocket import TlsClientConnection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from websockets.asyncio.client import ClientConnection

    from rce.config import Secret
    from rce.masters import Masters
    from rce.tls import Context


SILENCE_S = 30.0
"""How long a master may give no sign of life after a ping: it may be writing to a slow disk meanwhile."""


class TaskSetConnection(WatchedConnection, TlsClientConnection):
    """The task set's end of a connection, which watches the master for signs of life."""


class Dialer:
    """Dials the master beside the control channel.

    Args:
        masters: Where the masters are, as for :class:`~rce.control_channel.channel.TaskSetChannel`,
            whose master asks.
        secret: Proves that this is a task set of the same engine.
        timeouts: Times of this end.
        tls: Gives the TLS context for each connection to a ``wss://`` URL.
        connections: Where connections are noted, except those whose silence is not limited.
    """

    def __init__(
        self,
        masters: Masters,
        secret: Secret,
        timeouts: ControlTimeouts = DEFAULT_TIMEOUTS,
        *,
        tls: Context | None = None,
        connections: OpenConnections | None = None,
    ) -> None:
        self._connections = connections or OpenConnections()
        self._tls = tls
        self._masters = masters
        self._secret = secret
        self._timeouts = timeouts

    @contextlib.asynccontextmanager
    async def connect(
        self, path: str, max_size: int, *, silence: float | None = SILENCE_S
    ) -> AsyncIterator[ClientConnection]:
        """Connect to a path of the control port.

        Args:
            path: What the connection is for.
            max_size: Bytes of the longest message that is taken.
            silence: Seconds without a sign of life after a ping until the connection ends; None: they are
                not limited, for a master that may leave data unread.

        Raises:
            OSError: The master cannot be reached; ``TimeoutError`` if it does not answer.
            WebSocketException: It does not take the connection.
        """
        address = self._masters.current
        url = address.rstrip("/")
        async with asyncio.timeout(self._timeouts.open):
            sock = await open_url_socket(url)
        async with connect(
            url + path,
            sock=sock,
            additional_headers={"Authorization": f"Bearer {self._secret.reveal()}"},
            ssl=None if self._tls is None else self._tls(),
            compression=None,
            proxy=None,
            open_timeout=self._timeouts.open,
            ping_interval=self._timeouts.ping_interval,
            ping_timeout=silence,
            close_timeout=self._timeouts.close,
            max_size=max_size,
            max_queue=4,
            create_connection=TaskSetConnection,
        ) as master:
            if silence is None:
                yield master
                return
            with self._connections.noting(master.transport, address):
                yield master


class RunDialer(Dialer):
    """Dials the master for runs (:mod:`rce.control.execution`)."""

    @contextlib.asynccontextmanager
    async def dial(self, run: str) -> AsyncIterator[ClientConnection]:
        """Connect for a run; the errors are those of :meth:`connect`."""
        async with self.connect(path_of(run), MAX_DATA + 2, silence=None) as master:  # until the user reads
            yield master
