"""Connecting to a peer's link socket on behalf of a container."""

from __future__ import annotations

import asyncio
import socket

from rce.control.model import LinkAddress


async def dial(address: LinkAddress, machine: str) -> socket.socket:
    """Connect by the unix socket if it is on this machine, else by TCP.

    Raises:
        OSError: Nobody answers there.
    """
    if address.unix and address.machine == machine:
        try:
            return await _connect(socket.AF_UNIX, address.unix)
        except OSError:
            if not address.port:
                raise
    if not address.port:
        raise ConnectionError("the peer has no address that can be reached from here")
    infos = await asyncio.get_running_loop().getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    family, _, _, _, target = infos[0]
    return await _connect(family, target)


async def _connect(family: int, target: object) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        if family != socket.AF_UNIX:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.get_running_loop().sock_connect(sock, target)  # type: ignore[arg-type]
    except BaseException:
        sock.close()
        raise
    return sock
