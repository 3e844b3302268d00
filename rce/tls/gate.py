"""Accepts TLS connections: a server's protocol gets a connection only after its handshake.

asyncio's own TLS servers do not report failed handshakes, and do not count connections during the handshake.
Here an accepted connection waits in a lobby until its handshake is done. A failed one gives one line in the
log and an alert to the client, and a client that speaks plain HTTP is told so.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
from typing import TYPE_CHECKING, cast

from rce.aio.tasks import BackgroundTasks
from rce.guard import Lobby, LogThrottle, address_of
from rce.tls.alerts import alert_of
from rce.tls.faults import CertificateError, explain_to_server

if TYPE_CHECKING:
    from rce.tls.identity import Context

_log = logging.getLogger(__name__)

HANDSHAKE_S = 10.0
"""From an accepted connection to the end of its handshake."""
_SHUTDOWN_S = 1.0
"""For the other end's close of TLS."""
_HANDSHAKE_RECORD = 0x16
"""First byte of a TLS client."""
_TEXT = b"This port speaks TLS only: use https:// or wss://\n"
_PLAIN_ANSWER = (
    b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%b" % (len(_TEXT), _TEXT)
)


class TlsGate:
    """Does the handshakes of one server.

    Args:
        name: The service, for the log.
        context: Gives the context for the next connection.
        lobby: Where connections wait until their handshake is done.
    """

    def __init__(self, name: str, context: Context, lobby: Lobby) -> None:
        self._name = name
        self._context = context
        self._lobby = lobby
        self._handshakes = BackgroundTasks()
        self._throttle = LogThrottle()

    def guard(self, protocol: asyncio.Protocol) -> asyncio.Protocol:
        """Return a protocol factory for ``loop.create_server``, in place of ``protocol``."""
        return _Arrival(self, protocol)

    async def close(self) -> None:
        """End the handshakes that are not over."""
        await self._handshakes.close()

    def take(self, transport: asyncio.BaseTransport, protocol: asyncio.Protocol) -> None:
        """Take the socket of an accepted connection over, and shake hands on it."""
        accepted = transport.get_extra_info("socket")
        address = address_of(transport.get_extra_info("peername"))
        sock = None
        try:
            if not self._handshakes.closed:
                sock = socket.socket(fileno=os.dup(accepted.fileno()))
        except OSError as error:  # no descriptor is left
            self._complain(address, explain_to_server(error))
        finally:
            cast("asyncio.Transport", transport).abort()  # uvloop's only behave like one
        if sock is not None:
            self._handshakes.spawn(self._run(sock, protocol, address), name=f"TLS handshake with {address}")

    async def _run(self, sock: socket.socket, protocol: asyncio.Protocol, address: str) -> None:
        task = asyncio.current_task()
        assert task is not None
        guest = self._lobby.enter(address, task.cancel)
        if guest is None:
            sock.close()
            return
        try:
            async with asyncio.timeout(HANDSHAKE_S):
                first = await _first_byte(sock)
                if first == _HANDSHAKE_RECORD:
                    await self._shake_hands(sock, protocol)
                elif first is not None:
                    self._complain(address, "it does not speak TLS")
                    await _part(sock, _PLAIN_ANSWER)
        except (OSError, EOFError, TimeoutError, CertificateError) as error:
            self._complain(address, "no handshake in time" if _is_late(error) else explain_to_server(error))
            if alert := alert_of(error):
                await _part(sock, alert)
        finally:
            guest.leave()
            sock.close()

    async def _shake_hands(self, sock: socket.socket, protocol: asyncio.Protocol) -> None:
        context = self._context()
        # The transport owns this one and closes it later; the other one is closed here.
        own = socket.socket(fileno=os.dup(sock.fileno()))
        own.setblocking(False)
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: protocol,
                own,
                ssl=context,
                ssl_handshake_timeout=HANDSHAKE_S,
                ssl_shutdown_timeout=_SHUTDOWN_S,
            )
        except BaseException as error:
            if not alert_of(error):
                with contextlib.suppress(OSError):
                    sock.shutdown(socket.SHUT_RDWR)
            raise

    def _complain(self, address: str, why: str) -> None:
        # Limited for each reason: a logged one must not hide another.
        if self._throttle.is_due(f"{address} {why}", asyncio.get_running_loop().time()):
            _log.warning("%s: a client at %s was not taken: %s", self._name, address or "this machine", why)


class _Arrival(asyncio.Protocol):
    """A connection's protocol until its handshake."""

    def __init__(self, gate: TlsGate, protocol: asyncio.Protocol) -> None:
        self._gate = gate
        self._protocol = protocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._gate.take(transport, self._protocol)


async def _first_byte(sock: socket.socket) -> int | None:
    """Wait for the first byte and leave it there; None if the peer hung up."""
    sock.setblocking(False)
    while True:
        try:
            data = sock.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            await _readable(sock)
        else:
            return data[0] if data else None


async def _part(sock: socket.socket, words: bytes) -> None:
    """Send the last bytes to a client, and let it read them."""
    with contextlib.suppress(OSError):
        sock.send(words)
        sock.shutdown(socket.SHUT_WR)
        await _discard(sock)


async def _discard(sock: socket.socket) -> None:
    """Read until the peer hangs up, so that a reset does not discard the bytes sent to it."""
    loop = asyncio.get_running_loop()
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(_SHUTDOWN_S):
            while await loop.sock_recv(sock, 1 << 16):
                pass


async def _readable(sock: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    ready: asyncio.Future[None] = loop.create_future()
    loop.add_reader(sock, _resolve, ready)
    try:
        await ready
    finally:
        loop.remove_reader(sock)


def _resolve(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)


def _is_late(error: BaseException) -> bool:
    return isinstance(error, TimeoutError) or "handshake is taking longer" in str(error)
