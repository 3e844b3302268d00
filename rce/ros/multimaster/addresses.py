"""This machine's addresses, and the one for other machines to use."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

import psutil

from rce.lookups import LOOKUPS
from rce.ros.multimaster.errors import NoSuchInterfaceError
from rce.ros.node.settings import LOOPBACK, is_loopback

DEFAULT_GROUP = "226.0.0.0"
DEFAULT_PORT = 11511
RPC_PORT_OFFSET = 300
"""A discovery's RPC server has its master's port plus this."""

DEFAULT_MASTER_PORT = 11311
_MAX_PORT = 65535
_LONGEST_PORT = 6
"""Digits that tell a port, or that a number is too large for one."""


def split_group(text: str) -> tuple[str, str]:
    """Split ``group@interface``; either part may be missing."""
    group, _, interface = text.partition("@")
    return group or DEFAULT_GROUP, interface


def split_host(text: str, default: int) -> tuple[str, int]:
    """Split ``HOST`` or ``HOST:PORT``; without a port it is ``default``.

    Raises:
        ValueError: The text has another form, or the port is not one of 1 to 65535.
    """
    host, colon, port = text.partition(":")
    if not host or host.strip() != host or (colon and not (port.isascii() and port.isdigit())):
        raise ValueError(f"{text!r} is not HOST or HOST:PORT")
    number = int(port[:_LONGEST_PORT]) if colon else default
    if not 0 < number <= _MAX_PORT:
        raise ValueError(f"{text!r}: a port is a number of 1 to {_MAX_PORT}")
    return host, number


async def address_of(interface: str) -> str:
    """Return the IPv4 address of an interface, given by its name, address or host name.

    Raises:
        NoSuchInterfaceError: The interface does not exist, or has no IPv4 address.
    """
    for entry in psutil.net_if_addrs().get(interface, ()):
        if entry.family == socket.AF_INET:
            return entry.address
    try:
        infos = await LOOKUPS.addresses(interface, 0, family=socket.AF_INET)
        address: str = infos[0][4][0]
    except (OSError, UnicodeError) as error:
        raise NoSuchInterfaceError(
            f"{interface!r} is neither an interface with an IPv4 address nor a host"
        ) from error
    if address not in local_addresses() and not is_loopback(address):
        raise NoSuchInterfaceError(f"{interface!r} is not an address of this machine")
    return address


async def own_address(interface: str, group: str, environ: Mapping[str, str] | None = None) -> str:
    """Return the address under which others see this machine.

    Args:
        interface: The interface to use; if empty, ``ROS_IP`` or ``ROS_HOSTNAME``, else the one that the
            routing table chooses for ``group``, else loopback.
        group: The multicast group.
        environ: The environment.

    Raises:
        NoSuchInterfaceError: The interface is not there.
    """
    environ = os.environ if environ is None else environ
    named = interface or environ.get("ROS_IP", "")
    if named:
        return await address_of(named)
    if hostname := environ.get("ROS_HOSTNAME", ""):
        address = await address_of(hostname)
        if not is_loopback(address):  # on many systems the host name resolves to loopback
            return address
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((group, 9))  # a lookup in the routing table: nothing is sent
            found: str = probe.getsockname()[0]
        except OSError:
            return LOOPBACK
    return found


def local_addresses() -> frozenset[str]:
    """Return this machine's IPv4 addresses."""
    return frozenset(
        entry.address
        for entries in psutil.net_if_addrs().values()
        for entry in entries
        if entry.family == socket.AF_INET
    )


def local_hosts(*more: str) -> frozenset[str]:
    """Return all names and addresses that mean this machine."""
    return local_addresses() | {"localhost", LOOPBACK, socket.gethostname(), *more}


def public_uri(master_uri: str, address: str) -> str:
    """Return a master's URI as other machines can use it, with a slash at its end.

    A master that calls itself ``localhost`` would have the same URI as the masters of other machines.
    """
    parts = urlsplit(master_uri)
    host = parts.hostname or LOOPBACK
    if is_loopback(host) and not is_loopback(address):
        host = address
    return f"http://{host}:{parts.port or DEFAULT_MASTER_PORT}/"


def master_name(uri: str) -> str:
    """Return a master's default name: its host, and its port if that is not the default one."""
    parts = urlsplit(uri)
    host, port = parts.hostname or LOOPBACK, parts.port or DEFAULT_MASTER_PORT
    return host if port == DEFAULT_MASTER_PORT else f"{host}_{port}"
