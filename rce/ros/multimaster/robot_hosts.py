"""The hosts that multicast does not reach, by name or address."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterable

from rce.dialing import resolve

_log = logging.getLogger(__name__)

LOOK_AGAIN = 10.0
"""Seconds after which names are looked up again: a host may get another address."""


class RobotHosts:
    """Keeps the IPv4 addresses of hosts: an event loop sends datagrams to addresses only."""

    def __init__(self, hosts: Iterable[tuple[str, int]], on_found: Callable[[], None]) -> None:
        """Begin; nothing is looked up yet.

        Args:
            hosts: Names or addresses, with ports.
            on_found: Called when the address of a host is known or is another one.
        """
        self._hosts = list(hosts)
        self._on_found = on_found
        self._found: dict[str, str] = {}
        self._told: set[str] = set()

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """Addresses and ports of all hosts that are known."""
        return [(self._found[host], port) for host, port in self._hosts if host in self._found]

    async def follow(self) -> None:
        """Look up the hosts, again and again, until cancelled."""
        names = sorted({host for host, _ in self._hosts})
        async with asyncio.TaskGroup() as tasks:
            for name in names:
                tasks.create_task(self._follow(name), name=f"look up {name}")

    async def _follow(self, name: str) -> None:
        while True:
            try:
                found = [address[0] for family, address in await resolve(name, 0) if family == socket.AF_INET]
                if not found:
                    raise OSError("it has no IPv4 address")  # noqa: TRY301 - told as the others
            except (OSError, UnicodeError) as error:
                if name not in self._told:
                    self._told.add(name)
                    reason = getattr(error, "strerror", None) or error
                    _log.warning("no heartbeats to %s: the host name cannot be resolved: %s", name, reason)
            else:
                self._told.discard(name)
                if self._found.get(name) not in found:
                    self._found[name] = found[0]
                    self._on_found()
            await asyncio.sleep(LOOK_AGAIN)
