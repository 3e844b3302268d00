"""Connections to a host by its name.

An event loop's own ``create_connection`` is not used with names, for two reasons. uvloop looks a name up in a
future of its own; if the call is cancelled meanwhile (a timeout is enough), the lookup's failure is reported
on stderr as an exception that was never retrieved. And a program whose event loop looks a name up cannot end
until the name server has answered (:mod:`rce.lookups`).
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from typing import Any
from urllib.parse import urlsplit

from rce.lookups import LOOKUPS

_PORTS = {"https": 443, "wss": 443}

Address = tuple[socket.AddressFamily, Any]
"""Family and socket address."""


async def resolve(host: str, port: int) -> list[Address]:
    """Return the addresses of a host, the preferred first.

    Args:
        host: A name or an address.
        port: A TCP port.

    Raises:
        OSError: The name cannot be resolved (``socket.gaierror``).
    """
    found = _numeric(host, port)
    if found is not None:
        return [found]
    infos = await LOOKUPS.addresses(host, port)
    return [(socket.AddressFamily(family), address) for family, _, _, _, address in infos]


async def open_socket(host: str, port: int) -> socket.socket:
    """Connect by TCP to the first address of a host that answers.

    Give the result to ``create_connection(..., sock=...)`` or ``open_connection(sock=...)``.

    Args:
        host: A name or an address.
        port: A TCP port.

    Returns:
        A connected socket that does not block and sends without delay.

    Raises:
        OSError: The name cannot be resolved (``socket.gaierror``), or no address answers.
    """
    return await connect_first(await resolve(host, port))


async def open_url_socket(url: str) -> socket.socket:
    """Connect to the host of a WebSocket or HTTP URL as :func:`open_socket` does.

    Raises:
        OSError: The name cannot be resolved (``socket.gaierror``), or no address answers.
        ValueError: The URL has no host, or its port is not a number.
    """
    parts = urlsplit(url)
    if not parts.hostname:
        raise ValueError(f"{url!r} has no host")
    return await open_socket(parts.hostname, parts.port or _PORTS.get(parts.scheme, 80))


async def connect_first(addresses: list[Address]) -> socket.socket:
    """Connect to the first of some addresses that answers, as :func:`open_socket` does.

    Raises:
        ConnectionRefusedError: All addresses refuse; the text has the reason of each.
        OSError: No address answers; the text has the reason of each.
    """
    errors: list[OSError] = []
    for family, address in addresses:
        try:
            return await _connect(family, address)
        except OSError as error:
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    text = "; ".join(map(str, errors)) or "no address"
    if errors and all(isinstance(error, ConnectionRefusedError) for error in errors):
        raise ConnectionRefusedError(text)
    raise OSError(text)


def set_keepalive(sock: socket.socket, *, idle: int, interval: int, count: int) -> None:
    """Have the system end a TCP connection whose other end is gone without a word.

    Nothing happens if the socket has been closed.

    Args:
        sock: A TCP socket, or what an event loop gives in its place.
        idle: Seconds without data until the system asks the other end.
        interval: Seconds between two questions.
        count: How many of them stay unanswered until the connection is lost.
    """
    if sock.fileno() < 0:
        return
    with contextlib.suppress(OSError):  # macOS refuses options of a connection that is lost already
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (("TCP_KEEPIDLE", idle), ("TCP_KEEPINTVL", interval), ("TCP_KEEPCNT", count)):
            if hasattr(socket, option):
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


async def _connect(family: socket.AddressFamily, address: Any) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.get_running_loop().sock_connect(sock, address)
    except (OverflowError, ValueError) as error:  # an address that cannot be, such as port 70000
        sock.close()
        raise OSError(errno.EINVAL, f"cannot connect to {address}: {error}") from error
    except BaseException:
        sock.close()
        raise
    return sock


def _numeric(host: str, port: int) -> Address | None:
    """Return the address that ``host`` is already; None if it is a name. Saves a thread."""
    for family in (socket.AF_INET, socket.AF_INET6):
        try:
            socket.inet_pton(family, host)
        except (OSError, ValueError):
            continue
        return family, (host, port)
    return None
