"""The address by which others reach a program that accepts links or robots."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from typing import TYPE_CHECKING

from rce.lookups import LOOKUPS

if TYPE_CHECKING:
    from collections.abc import Coroutine

_SOMEWHERE = "192.0.2.1"
"""An address for documentation (RFC 5737), never assigned: the route to it is the route to the Internet."""


async def own_address(master: str, port: int, hurry: asyncio.Event | None = None) -> str:
    """Return the address of this machine on the way to the master, or outside if the master is here.

    This sends nothing, except a query to the name server if the master is given by name.

    Args:
        master: Host of the master.
        port: Its port.
        hurry: Once this is set, the answer to that query is not waited for.
    """
    found = await _unless(hurry or asyncio.Event(), _address_towards(master, port))
    if found is None or ipaddress.ip_address(found).is_loopback:
        found = await _address_towards(_SOMEWHERE, port)
    return found or "127.0.0.1"


def is_any(host: str) -> bool:
    """Return whether binding ``host`` binds every address of the machine."""
    return host in ("", "0.0.0.0", "::")  # noqa: S104 - compared, not bound


def in_url(host: str) -> str:
    """Write a host as URLs need it."""
    return f"[{host}]" if ":" in host else host


async def _address_towards(host: str, port: int) -> str | None:
    with contextlib.suppress(OSError, UnicodeError):
        family, _, _, _, address = (await LOOKUPS.addresses(host, port, kind=socket.SOCK_DGRAM))[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0]).partition("%")[0]
    return None


async def _unless(event: asyncio.Event, work: Coroutine[None, None, str | None]) -> str | None:
    """Return the result of some work; None if an event is set before there is one."""
    tasks = asyncio.ensure_future(work), asyncio.ensure_future(event.wait())
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return tasks[0].result() if tasks[0].done() else None
    finally:
        for task in tasks:
            task.cancel()
