"""Begin TLS on a link's connection; :mod:`rce.link.encryption` describes what the handshake proves."""

from __future__ import annotations

import asyncio
import os
import socket
from typing import TYPE_CHECKING

from rce.link.encryption import accepting_context, dialing_context
from rce.link.exceptions import LinkRefusedError
from rce.link.handshake import encode_secure

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce.control import LinkSpec
    from rce.link.socket_carrier import SocketCarrier


async def dial_secure(
    sock: socket.socket, spec: LinkSpec, make: Callable[[], SocketCarrier]
) -> SocketCarrier:
    """Begin TLS as the dialing end of a connected socket.

    Args:
        sock: Closed if this succeeds; the carrier has the connection then.
        spec: The link.
        make: Makes the carrier.

    Raises:
        LinkRefusedError: The peer does not accept TLS.
        OSError: The handshake failed (:class:`ssl.SSLError`).
    """
    if not spec.address.tls:
        raise LinkRefusedError(f"{spec.peer} takes links without TLS only; start its program with --tls")
    context = await asyncio.to_thread(dialing_context, spec.token)
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(sock, encode_secure(spec.id))
    _, carrier = await loop.create_connection(make, sock=_handed_on(sock), ssl=context, server_hostname="")
    sock.close()
    return carrier


async def accept_secure(sock: socket.socket, spec: LinkSpec, make: Callable[[], SocketCarrier]) -> None:
    """Begin TLS as the accepting end of a socket whose peer has announced it.

    Args:
        sock: Closed if this succeeds; the carrier has the connection then.
        spec: The link.
        make: Makes the carrier.

    Raises:
        OSError: The handshake failed (:class:`ssl.SSLError`): the peer does not know the link's token.
    """
    context = await asyncio.to_thread(accepting_context, spec.token)
    await asyncio.get_running_loop().connect_accepted_socket(make, _handed_on(sock), ssl=context)
    sock.close()


def _handed_on(sock: socket.socket) -> socket.socket:
    """Return the connection as a socket that a transport may close in its own time, if a handshake fails."""
    return socket.socket(fileno=os.dup(sock.fileno()))


class Adopter:
    """Takes connections that a link acceptor accepted for a hub of its own process.

    Args:
        adopt: As :meth:`rce.link.hub.LinkHub.adopt`.
    """

    def __init__(self, adopt: Callable[[socket.socket, bytes], Awaitable[None]]) -> None:
        self._adopt = adopt

    async def send(self, connection: socket.socket, received: bytes) -> None:
        """Take a connection; the caller closes its own copy."""
        await self._adopt(_handed_on(connection), received)
