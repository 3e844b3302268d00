"""WebSocket connections that are watched for signs of life in place of the library's keepalive.

The keepalive of ``websockets`` counts only answers to its own pings. Behind a large message on a slow link
such an answer comes late, and the ping itself waits until the write buffer is almost empty, for ever if the
other side takes nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from websockets.asyncio.connection import Connection
from websockets.frames import CloseCode
from websockets.protocol import State

from rce.liveness.watch import Watch

if TYPE_CHECKING:
    import asyncio


class WatchedConnection(Connection):
    """A connection for ``create_connection``, before the library's own class among the bases.

    The library's ``ping_interval`` and ``ping_timeout`` are those of the :class:`~rce.liveness.Watch`.
    """

    _watch: Watch | None = None
    _deadline: asyncio.TimerHandle | None = None
    """When a connection that was given up is dropped."""
    _data_came = False

    def start_keepalive(self) -> None:
        """Begin to watch; called by the library after the handshake."""
        if self.ping_interval is not None and self.protocol.state is State.OPEN:
            self._watch = Watch(self, self.ping_interval, self.ping_timeout)

    def data_received(self, data: bytes) -> None:
        """Take note of a sign of life."""
        self._data_came = True
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Watch no longer."""
        if self._watch is not None:
            self._watch.stop()
            self._watch = None
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    # Called by the watch

    @property
    def writable(self) -> bool:
        """Whether it is open and its write buffer below the limit."""
        return not self.paused and self.protocol.state is State.OPEN

    def heard(self) -> bool:
        """Return whether data came since the last call; while it is not read, it may have come."""
        came, self._data_came = self._data_came, False
        return came or not self.transport.is_reading()

    def send_ping(self) -> None:
        """Write a ping, also if much waits already."""
        if self.protocol.state is State.OPEN:
            self.protocol.send_ping(b"")
            self.send_data()

    def give_up(self, silent: float) -> None:
        """End the connection, which has been silent for so many seconds."""
        self._deadline = self.loop.call_later(self.close_timeout or 0.0, self.transport.abort)
        if self.protocol.state is State.OPEN:
            self.protocol.fail(CloseCode.INTERNAL_ERROR, f"no sign of life for {silent:.0f} s")
            self.send_data()
