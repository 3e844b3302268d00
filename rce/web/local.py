"""Tells requests of this machine's own user from those that a proxy passes on for others."""

from __future__ import annotations

import ipaddress
import os
import socket
import struct
from typing import TYPE_CHECKING, TypeAlias

from aiohttp import HttpVersion11, hdrs

from rce.web.origin import host_of

if TYPE_CHECKING:
    from aiohttp import web

Address: TypeAlias = "tuple[str, int]"

_FORWARDED = frozenset(["forwarded", "via", "x-real-ip", "cf-connecting-ip", "true-client-ip"])
_FORWARDED_PREFIX = "x-forwarded-"

_NETLINK_SOCK_DIAG, _SOCK_DIAG_BY_FAMILY, _REQUEST = 4, 20, 1
_HEADER = struct.Struct("=IHHII")
_QUERY = struct.Struct("=BBBxI")
_CONNECTION = struct.Struct("!HH16s16s")
_ANY_INTERFACE_AND_COOKIE = struct.pack("=III", 0, 0xFFFFFFFF, 0xFFFFFFFF)
_USER = struct.Struct("=II")
"""In an answer: the user and the inode, at its end."""
_ANSWER_SIZE = 72
_ANSWER_TIMEOUT_S = 0.5
_OPEN_STATES = frozenset([1, 8])
"""ESTABLISHED and CLOSE_WAIT: the kernel names user 0 for connections that their program has closed."""


def why_not_local(request: web.Request) -> str | None:
    """Return why a request may come from another user or machine; None if a program of this user sent it.

    Headers alone do not tell: a proxy may pass requests on without a trace. But the kernel knows which user
    opened the connection, and proxies run as users of their own.

    Args:
        request: The request.
    """
    if _is_forwarded(request):
        return "it comes through a proxy, or is of HTTP/1.0"
    if not _is_loopback(host_of(request.headers.get(hdrs.HOST, ""))):
        return "its Host is not 127.0.0.1, [::1] or localhost"
    peer, own = (request.get_extra_info(name) for name in ("peername", "sockname"))
    if not peer or not own or not _is_loopback(peer[0]):
        return "it comes from another computer"
    try:
        user = user_of(peer[:2], own[:2])
    except OSError as error:
        return f"the system does not tell which user sends it ({error.strerror or error})"
    if user not in _own_users():
        return f"the program that sends it, perhaps a proxy, runs as another user ({user})"
    return None


def user_of(client: Address, server: Address) -> int:
    """Return the number of the user whose program opened a TCP connection of this machine.

    Args:
        client: Address and port of the client.
        server: Those of the server.

    Raises:
        OSError: The client has closed the connection, or the system does not tell.
    """
    near, far = (ipaddress.ip_address(address) for address, _ in (client, server))
    family = socket.AF_INET if near.version == 4 else socket.AF_INET6  # noqa: PLR2004 - IPv4
    query = _QUERY.pack(family, socket.IPPROTO_TCP, 0, 0xFFFFFFFF)
    ends = _CONNECTION.pack(client[1], server[1], near.packed.ljust(16, b"\0"), far.packed.ljust(16, b"\0"))
    body = query + ends + _ANY_INTERFACE_AND_COOKIE
    header = _HEADER.pack(_HEADER.size + len(body), _SOCK_DIAG_BY_FAMILY, _REQUEST, 0, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG) as kernel:
        kernel.settimeout(_ANSWER_TIMEOUT_S)
        kernel.sendto(header + body, (0, 0))
        answer = kernel.recv(4096)
    kind = _HEADER.unpack_from(answer)[1]
    found = answer[_HEADER.size :]
    if kind != _SOCK_DIAG_BY_FAMILY or len(found) < _ANSWER_SIZE or found[1] not in _OPEN_STATES:
        raise ConnectionError("its connection is closed")
    user, _ = _USER.unpack_from(found, _ANSWER_SIZE - _USER.size)
    return int(user)


def _is_forwarded(request: web.Request) -> bool:
    if request.version < HttpVersion11:  # nginx sends 1.0 without other traces, and programs of today 1.1
        return True
    names = [name.lower() for name in request.headers]
    return any(name in _FORWARDED or name.startswith(_FORWARDED_PREFIX) for name in names)


def _own_users() -> set[int]:
    """Return the user of this program, and who started it with sudo."""
    own = os.geteuid()
    starter = os.environ.get("SUDO_UID", "") if own == 0 else ""
    return {own, int(starter)} if starter.isdecimal() else {own}


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
