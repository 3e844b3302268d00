"""Makes the certificates of an engine that ``rce up`` runs, and renews them while it runs."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from pathlib import Path
from typing import TYPE_CHECKING

from rce.lookups import LOOKUPS
from rce.masters import split_addresses, split_port
from rce.tls.faults import CertificateError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from rce.config import EngineSettings

CHECK_EVERY_S = 6 * 3600.0


_NAME_SIGNS = str.maketrans("", "", "-._")
_INTERNET = (socket.AF_INET, socket.AF_INET6)
_IPV6_ADDRESSES = Path("/proc/net/if_inet6")
_TEMPORARY = 0x01
"""The kernel's IFA_F_TEMPORARY."""


@contextlib.asynccontextmanager
async def keep_certificates(settings: EngineSettings, say: Callable[[str], None]) -> AsyncIterator[None]:
    """Keep the engine's certificate valid while the context lasts. Does nothing for an engine without TLS.

    Args:
        settings: Of the engine.
        say: Called with a text on each certificate that was made or renewed.

    Raises:
        CertificateError: The certificates cannot be made.
    """
    if not settings.tls.enabled:
        yield
        return
    full_name = await LOOKUPS.own_name()
    if done := await asyncio.to_thread(ensure, settings, full_name):
        say(done)
    task = asyncio.create_task(_keep(settings, say))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


def ensure(settings: EngineSettings, full_name: str) -> str:
    """Make the missing certificates of the engine; blocks.

    Args:
        settings: Of the engine.
        full_name: Of this machine.

    Returns:
        What was done, in words; empty if nothing.

    Raises:
        CertificateError: They cannot be made.
    """
    from rce.tls.folder import CertificateFolder  # takes 10 MB, which only engines with TLS spend

    binds = (settings.master.bind, settings.robot.bind, settings.container.bind)
    masters = [split_port(address, 0)[0] for address in split_addresses(settings.master_host)]
    named = (*masters, settings.robot.public_host or "", *binds)
    folder = CertificateFolder(settings.certificates.absolute())
    return folder.ensure(settings.tls.name, own_hosts((full_name, *named)))


async def _keep(settings: EngineSettings, say: Callable[[str], None]) -> None:
    while True:
        await asyncio.sleep(CHECK_EVERY_S)
        try:
            done = await asyncio.to_thread(ensure, settings, await LOOKUPS.own_name())
        except (CertificateError, OSError) as error:
            done = f"cannot renew certificates: {error}"
        if done:
            say(done)


def own_hosts(more: Iterable[str] = ()) -> tuple[str, ...]:
    """Return this machine's names and lasting addresses, and those of ``more`` that name a machine.

    No name server is asked.
    """
    import psutil

    found = ["localhost", "127.0.0.1", "::1", socket.gethostname()]
    brief = _temporary_addresses()
    for addresses in psutil.net_if_addrs().values():
        found += [
            address.address
            for address in addresses
            if address.family in _INTERNET and address.address not in brief
        ]
    return tuple(dict.fromkeys(host for host in (*found, *more) if _is_useful(host)))


def _temporary_addresses() -> set[str]:
    """Return the IPv6 addresses that the machine replaces after a day, and that serve its own connections."""
    try:
        lines = [line.split() for line in _IPV6_ADDRESSES.read_text().splitlines()]
    except OSError:  # a machine without IPv6
        return set()
    return {
        str(ipaddress.IPv6Address(int(address, 16)))
        for address, _, _, _, flags, _ in lines
        if int(flags, 16) & _TEMPORARY
    }


def _is_useful(host: str) -> bool:
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host.isascii() and host.translate(_NAME_SIGNS).isalnum()
    return not address.is_link_local and not address.is_unspecified
