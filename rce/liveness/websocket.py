"""WebSocket connections that are watched for signs of life in place of the library's keepalive.

The keepalive of ``websockets`` counts only answers to its own pings. Behind a large message on a slow link
such an answer comes late, and the ping itself waits until the write buffer is almost empty, without a limit
if the other side takes nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from websockets.asyncio.connection import Connection
from websockets.frames import CloseCode
from websockets.protocol import State

from rce.liveness.signs import Outflow
from rce.liveness.watch import Watch

if TYPE_CHECKING:
    import asyncio


class WatchedConnection(Connection):
    """A connection for ``create_connection``, before the library's own class among the bases.

    The library's ``ping_interval`` and ``ping_timeout`` are those of the :class:`~rce.liveness.Watch`.
    """

    _watch: Watch | None = None
    _deadline: asyncio.TimerHandle | None = None
    """When a connection that is to end is dropped."""
    _closing: asyncio.TimerHandle | None = None
    """When it is next seen whether the other side takes what waits while it is closed."""
    _has_heard = False
    is_silent = False
    """Whether the connection was ended because the other side gave no sign of life."""

    @property
    def writable(self) -> bool:
        """Whether the connection is open and its write buffer below the limit."""
        return not self.paused and self.protocol.state is State.OPEN

    @property
    def silence(self) -> float:
        """For how many seconds the other side gave no sign of life; 0: it is not watched."""
        return 0.0 if self._watch is None else self._watch.silence

    def watch(self, ping_interval: float, ping_timeout: float | None) -> None:
        """Ping the other side from now on, and end the connection if it gives no sign of life.

        Args:
            ping_interval: Seconds from one ping to the next.
            ping_timeout: Seconds without a sign of life after a ping; None: they are not limited.
        """
        if self.protocol.state is State.OPEN:
            self._watch = Watch(self, ping_interval, ping_timeout)

    def end_soon(self) -> None:
        """Drop the connection after the close timeout, also if the other side goes on sending."""
        if self._deadline is None and not self.transport.is_closing():
            self._deadline = self.loop.call_later(self.close_timeout or 0.0, self.transport.abort)

    async def close(self, code: CloseCode | int = CloseCode.NORMAL_CLOSURE, reason: str = "") -> None:
        """Close the connection; return when it has ended.

        It is dropped if the other side takes nothing for the close timeout while data waits to be sent; the
        library's own limit begins after that wait. A side whose silence is not limited may take its time.
        """
        if self.ping_timeout is None:
            await super().close(code, reason)
            return
        outflow = Outflow(self.transport)
        self._look_while_closing(outflow)
        try:
            await super().close(code, reason)
        finally:
            if self._closing is not None:
                self._closing.cancel()

    def _look_while_closing(self, outflow: Outflow) -> None:
        if self._closing is not None and not outflow.moved():
            self.transport.abort()
        else:
            self._closing = self.loop.call_later(self.close_timeout or 0.0, self._look_while_closing, outflow)

    # Called by the library

    def start_keepalive(self) -> None:
        """Begin to watch, after the handshake."""
        if self.ping_interval is not None:
            self.watch(self.ping_interval, self.ping_timeout)

    def data_received(self, data: bytes) -> None:
        """Take note of a sign of life."""
        self._has_heard = True
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the watch."""
        if self._watch is not None:
            self._watch.stop()
            self._watch = None
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    # Called by the watch

    def heard(self) -> bool:
        """Return whether data came since the last call; while it is not read, it may have come."""
        heard, self._has_heard = self._has_heard, False
        return heard or not self.transport.is_reading()

    def send_ping(self) -> None:
        """Write a ping, also if much waits already."""
        if self.protocol.state is State.OPEN:
            self.protocol.send_ping(b"")
            self.send_data()

    def give_up(self, silent: float) -> None:
        """End the connection, which has been silent for so many seconds."""
        self.is_silent = True
        self.end_soon()
        if self.protocol.state is State.OPEN:
            self.protocol.fail(CloseCode.INTERNAL_ERROR, f"no sign of life for {silent:.0f} s")
            self.send_data()
