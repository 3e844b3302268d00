"""Lines of text with file descriptors over a unix stream socket: the transport of the control messages."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections import deque
from collections.abc import Callable

from rce_container.environment.exceptions import ChannelError

MAX_LINE = 16 << 20
"""Bytes; a container's whole specification is one line."""
MAX_UNSENT = 64 << 20
"""Bytes that may wait for a peer that does not read."""
MAX_UNSENT_FDS = 512
"""Descriptors that may wait for it."""
_CHUNK = 1 << 16
_MAX_FDS = 16


class Channel:
    """One end of a connected unix stream socket.

    A descriptor arrives no later than the line it was sent with.
    One task receives; any task may send. The channel owns the socket and the descriptors that were not taken.

    Args:
        sock: The socket.
        takes_fds: Whether the peer may send descriptors; else the kernel drops them.
    """

    def __init__(self, sock: socket.socket, *, takes_fds: bool = True) -> None:
        sock.setblocking(False)
        self._takes_fds = takes_fds
        self._sock = sock
        self._loop = asyncio.get_running_loop()
        self._received = bytearray()
        self._scanned = 0
        self._fds: deque[int] = deque()
        self._unsent: deque[tuple[memoryview, int | None]] = deque()
        self._unsent_bytes = 0
        self._unsent_fds = 0
        self._draining: asyncio.Future[None] | None = None
        self._closed = False
        self._waiting: asyncio.Future[None] | None = None

    async def receive(self) -> bytes | None:
        """Wait for the next line; return None when the connection has ended.

        Raises:
            ChannelError: The line is longer than :data:`MAX_LINE`.
        """
        while True:
            end = self._received.find(b"\n", self._scanned)
            if end >= 0:
                line = bytes(self._received[:end])
                del self._received[: end + 1]
                self._scanned = 0
                return line
            self._scanned = len(self._received)
            if self._scanned > MAX_LINE:
                raise ChannelError(f"a line of more than {MAX_LINE} bytes")
            if not await self._fill():
                return None

    def take_fd(self) -> int:
        """Take the oldest received descriptor; the caller owns it.

        Raises:
            ChannelError: No descriptor was received.
        """
        if not self._fds:
            raise ChannelError("the message should have come with a file descriptor")
        return self._fds.popleft()

    def send(self, line: bytes, fd: int | None = None) -> None:
        """Send a line, and a duplicate of ``fd`` with it. Never blocks; does nothing on a closed channel.

        The channel closes if its peer leaves more than :data:`MAX_UNSENT` bytes, or :data:`MAX_UNSENT_FDS`
        descriptors, unread.
        """
        if self._closed:
            return
        idle = not self._unsent
        self._unsent.append((memoryview(line + b"\n"), None if fd is None else os.dup(fd)))
        self._unsent_bytes += len(line) + 1
        self._unsent_fds += fd is not None
        if self._unsent_bytes > MAX_UNSENT or self._unsent_fds > MAX_UNSENT_FDS:
            self.close()
        elif idle:
            self._flush()
            if self._unsent:
                self._loop.add_writer(self._sock, self._flush)

    async def drain(self, most: int) -> None:
        """Wait until no more than ``most`` lines wait for the peer to read, or the channel is closed.

        Only one task may wait at a time.
        """
        while len(self._unsent) > most and not self._closed:
            self._draining = self._loop.create_future()
            await self._draining

    def close(self) -> None:
        """Close the connection and all descriptors that were not taken or not sent."""
        if self._closed:
            return
        self._closed = True
        self._loop.remove_reader(self._sock)
        self._loop.remove_writer(self._sock)
        self._sock.close()
        for fd in [*self._fds, *(fd for _, fd in self._unsent if fd is not None)]:
            os.close(fd)
        self._fds.clear()
        self._unsent.clear()
        _wake(self._waiting)
        _wake(self._draining)

    def _flush(self) -> None:
        while self._unsent and not self._closed:
            data, fd = self._unsent[0]
            try:
                sent = self._sock.send(data) if fd is None else socket.send_fds(self._sock, [data], [fd])
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                self.close()
                return
            if fd is not None:
                os.close(fd)
                self._unsent_fds -= 1
            self._unsent_bytes -= sent
            if sent == len(data):
                self._unsent.popleft()
                _wake(self._draining)
            else:
                self._unsent[0] = (data[sent:], None)
        if not self._closed:
            self._loop.remove_writer(self._sock)

    async def _fill(self) -> bool:
        while not self._closed:
            try:
                data = self._read()
            except (BlockingIOError, InterruptedError):
                await self._readable()
                continue
            except OSError:
                return False
            self._received += data
            await asyncio.sleep(0)  # a peer that never pauses must not keep all others waiting
            return bool(data)
        return False

    def _read(self) -> bytes:
        if not self._takes_fds:
            return self._sock.recv(_CHUNK)
        data, fds, _, _ = socket.recv_fds(self._sock, _CHUNK, _MAX_FDS)
        for fd in fds:  # recv_fds of Python 3.11 does not pass MSG_CMSG_CLOEXEC on
            os.set_inheritable(fd, False)
        self._fds.extend(fds)
        return data

    async def _readable(self) -> None:
        waiting = self._waiting = self._loop.create_future()
        self._loop.add_reader(self._sock, _wake, waiting)
        try:
            await waiting
        finally:
            self._waiting = None
            if not self._closed:
                self._loop.remove_reader(self._sock)


def _wake(waiting: asyncio.Future[None] | None) -> None:
    if waiting is not None and not waiting.done():
        waiting.set_result(None)


async def accept(listener: socket.socket, take: Callable[[socket.socket], None]) -> None:
    """Pass every connection that a listening socket accepts to ``take``, until cancelled."""
    loop = asyncio.get_running_loop()
    listener.setblocking(False)
    while True:
        sock, _ = await loop.sock_accept(listener)
        try:
            take(sock)
        except BaseException:
            with contextlib.suppress(OSError):
                sock.close()
            raise


async def connect(path: str) -> Channel:
    """Connect to a unix socket, as a manager does: the listener cannot send descriptors.

    Raises:
        OSError: No process listens there.
    """
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, path)
    except BaseException:
        sock.close()
        raise
    return Channel(sock, takes_fds=False)
