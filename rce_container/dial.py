"""Connecting to a peer's link socket on behalf of a container."""

from __future__ import annotations

import asyncio
import socket

from rce.control.model import LinkAddress
from rce.dialing import open_socket


async def dial(address: LinkAddress, machine: str, *, tls: bool = False) -> socket.socket:
    """Connect by the unix socket if it is on this machine, else by TCP.

    Args:
        address: Of the peer.
        machine: Name of this machine.
        tls: Refuse peers that take links by TCP without TLS.

    Raises:
        OSError: Nobody answers there, or without TLS only.
    """
    if address.unix and address.machine == machine:
        try:
            return await _connect_unix(address.unix)
        except OSError:
            if not address.port:
                raise
    if not address.port:
        raise ConnectionError("the peer has no address that can be reached from here")
    if tls and not address.tls:
        raise ConnectionError("the peer takes links without TLS only; start its program with --tls")
    return await open_socket(address.host, address.port)


async def _connect_unix(path: str) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, path)
    except BaseException:
        sock.close()
        raise
    return sock
