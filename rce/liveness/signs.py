"""Whether the other side of a connection still takes part: what is a sign of life, and when it is missed.

A program that hangs, or whose machine is gone without a word, closes no connection. So after a while without
a sign of life it is pinged, and after some more the connection counts as lost. A slow link does not count:
behind a large message in either direction, a ping or its answer may take many seconds. Signs of life are
therefore

- any data from the other side, also a part of a message;
- data that the other side took, if more of it waits here because the link or the other side is slow, or if
  the ping itself is still on its way. (Without that condition it would be none: the kernel of a machine takes
  data for a program that hangs, as long as there is room.)
"""

from __future__ import annotations

import socket
import struct
import sys
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if sys.platform.startswith("linux"):
    import fcntl
    import termios

if TYPE_CHECKING:
    import asyncio
    from asyncio.trsock import TransportSocket

LOOKS = 4
"""Looks for signs of life in the shorter of the two times."""
_TCP_INFO = struct.Struct("=120xQ16xI")
"""``tcpi_bytes_acked`` and ``tcpi_notsent_bytes`` of Linux's ``struct tcp_info``."""


class Step(Enum):
    """What to do after a look."""

    NOTHING = "nothing"
    PING = "ping"
    GIVE_UP = "give up"


@dataclass(slots=True)
class Liveness:
    """Counts the time without a sign of life. Pure.

    Args:
        ping_after: Seconds without one until a ping is sent.
        lost_after: Seconds from then until the connection counts as lost; None: never.
    """

    ping_after: float
    lost_after: float | None
    silent: float = 0.0
    """Seconds without a sign of life."""
    _pinged: bool = False

    @property
    def period(self) -> float:
        """Seconds from one look to the next."""
        return min(self.ping_after, self.lost_after or self.ping_after) / LOOKS

    def look(self, elapsed: float, *, heard: bool, moved: bool = False) -> Step:
        """Take note of a look.

        Args:
            elapsed: Seconds since the last one. More than two periods count as two: this program slept, or
                was busy, and could not see a sign of life either.
            heard: Whether data came from the other side since.
            moved: Whether data that waited went to it.
        """
        if heard:
            self.silent, self._pinged = 0.0, False
            return Step.NOTHING
        if moved:  # the answer to a ping is due later
            self.silent = self.ping_after if self._pinged else 0.0
            return Step.NOTHING
        self.silent += min(elapsed, 2 * self.period)
        if not self._pinged:
            if self.silent < self.ping_after:
                return Step.NOTHING
            self.silent, self._pinged = self.ping_after, True
            return Step.PING
        lost = self.lost_after is not None and self.silent >= self.ping_after + self.lost_after
        return Step.GIVE_UP if lost else Step.NOTHING


class Outflow:
    """Tells whether the other side takes what waits to be sent.

    Args:
        transport: Of the connection.
    """

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._taken, self._waiting = self._read()
        self._mark = self._taken
        """What was taken once a ping was."""

    def pinged(self) -> None:
        """Take note that a ping was written."""
        self._mark = self._read()[0] + self._transport.get_write_buffer_size() + self._in_kernel()

    def moved(self) -> bool:
        """Return whether data was taken since the last call, if more waited or a ping was on its way."""
        taken, waiting = self._read()
        found = taken > self._taken and (self._waiting or self._taken < self._mark)
        self._taken, self._waiting = taken, waiting
        return found

    def _socket(self) -> TransportSocket | None:
        """Return the socket, where the system can tell of it; none once the transport has closed it."""
        sock: TransportSocket | None = self._transport.get_extra_info("socket")
        if not sys.platform.startswith("linux") or sock is None or sock.fileno() < 0:
            return None
        return sock

    def _in_kernel(self) -> int:
        """Return the bytes that were written to the kernel, and that the other side has not taken."""
        if (sock := self._socket()) is None:
            return 0
        try:
            return int.from_bytes(fcntl.ioctl(sock.fileno(), termios.TIOCOUTQ, bytes(4)), sys.byteorder)
        except OSError:
            return 0

    def _read(self) -> tuple[int, bool]:
        """Return a number that grows with the data that was taken, and whether more waits."""
        buffered = self._transport.get_write_buffer_size()
        if (sock := self._socket()) is None:
            return -buffered, buffered > 0
        try:
            info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
            acknowledged, unsent = _TCP_INFO.unpack(info)
        except (OSError, struct.error):  # not TCP, or a kernel before 4.6
            return -buffered, buffered > 0
        return acknowledged, buffered > 0 or unsent > 0
