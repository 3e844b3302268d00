"""The names and addresses by which others reach this machine."""

from __future__ import annotations

import ipaddress
import socket
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    from collections.abc import Iterable

_NAME_SIGNS = str.maketrans("", "", "-._")
_INTERNET = (socket.AF_INET, socket.AF_INET6)


def own_hosts(more: Iterable[str] = ()) -> tuple[str, ...]:
    """Return this machine's names and addresses, and those of ``more`` that name a machine.

    No name server is asked.
    """
    found = ["localhost", "127.0.0.1", "::1", socket.gethostname()]
    for addresses in psutil.net_if_addrs().values():
        found += [address.address for address in addresses if address.family in _INTERNET]
    return tuple(dict.fromkeys(host for host in (*found, *more) if _is_useful(host)))


def _is_useful(host: str) -> bool:
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host.isascii() and host.translate(_NAME_SIGNS).isalnum()
    return not address.is_link_local and not address.is_unspecified
