"""Which address a program that accepts links, or robots, is known by to others."""

from __future__ import annotations

import contextlib
import ipaddress
import socket

_SOMEWHERE = "192.0.2.1"
"""An address that nobody has (RFC 5737); the way to it is the way to everybody outside."""


def own_address(master: str, port: int) -> str:
    """Return the address of this machine on the way to the master, or outside if the master is here.

    Nothing is sent for it.
    """
    found = _address_towards(master, port)
    if found is None or ipaddress.ip_address(found).is_loopback:
        found = _address_towards(_SOMEWHERE, port)
    return found or "127.0.0.1"


def is_any(host: str) -> bool:
    """Tell whether binding ``host`` binds every address of the machine."""
    return host in ("", "0.0.0.0", "::")  # noqa: S104 - compared, not bound


def in_url(host: str) -> str:
    """Write a host as URLs need it."""
    return f"[{host}]" if ":" in host else host


def _address_towards(host: str, port: int) -> str | None:
    with contextlib.suppress(OSError):
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0]).partition("%")[0]
    return None
