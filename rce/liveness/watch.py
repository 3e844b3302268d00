"""Pings the other side of a connection, and notices when it gives no sign of life any more.

Timers instead of a task: nothing here waits for the connection, which may be full.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

from rce.liveness.signs import Liveness, Outflow, Step


class Watched(Protocol):
    """The connection of a :class:`Watch`."""

    transport: asyncio.Transport

    @property
    def writable(self) -> bool:
        """Whether it is open and its write buffer below the limit."""

    def heard(self) -> bool:
        """Return whether data came since the last call, or came before and is still to be handled."""

    def send_ping(self) -> None:
        """Write a ping, however much waits already; nothing if the connection is not open any more."""

    def give_up(self, silent: float) -> None:
        """End the connection: there was no sign of life for ``silent`` seconds."""


class Watch:
    """Watches a connection until :meth:`stop`.

    While the other side takes data, it is pinged regularly also if it sends: proxies on the way end
    connections in which nothing goes to it.

    Args:
        connection: The connection.
        ping_interval: Seconds from one ping to the next.
        ping_timeout: Seconds without a sign of life after a ping; None: they are not limited.
    """

    def __init__(self, connection: Watched, ping_interval: float, ping_timeout: float | None) -> None:
        self._connection = connection
        self._interval = ping_interval
        self._liveness = Liveness(ping_interval, ping_timeout)
        self._outflow = Outflow(connection.transport)
        self._loop = asyncio.get_running_loop()
        self._looked = self._pinged = self._loop.time()
        self._timer = self._loop.call_later(self._liveness.period, self._look)

    @property
    def silence(self) -> float:
        """For how many seconds there was no sign of life, as of the last look."""
        return self._liveness.silent

    def stop(self) -> None:
        """Stop watching."""
        self._timer.cancel()

    def _look(self) -> None:
        now, connection = self._loop.time(), self._connection
        moved = self._outflow.moved()
        step = self._liveness.look(now - self._looked, heard=connection.heard(), moved=moved)
        self._looked = now
        if step is Step.GIVE_UP:
            connection.give_up(self._liveness.silent)
            return
        is_due = now - self._pinged >= self._interval and connection.writable
        if step is Step.PING or is_due:
            self._pinged = now
            connection.send_ping()
        if step is Step.PING:
            self._outflow.pinged()
        self._timer = self._loop.call_later(self._liveness.period, self._look)
