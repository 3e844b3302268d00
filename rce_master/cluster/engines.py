"""The engines whose state an etcd keeps, each below a prefix of its own, and their masters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rce.config.store_address import DEFAULT_PREFIX
from rce_master.store.etcd.layout import Keys, read_master
from rce_master.store.etcd.wire import Delete

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_master.store.etcd.client import EtcdClient

_PAGE = 1000
"""Keys that are read at a time."""
_SCHEMA = "/schema"
_AFTER_SLASH = "0"
"""The character after ``/``: what begins with it comes after all keys of a folder."""


@dataclass(frozen=True, slots=True)
class EngineMaster:
    """A master of one of the engines, as etcd knows it."""

    name: str
    """``MACHINE:PORT``."""
    host: str
    """Where other masters reach it."""
    prefix: str
    """Of its engine's keys."""

    @property
    def shown(self) -> str:
        """Its name; with the prefix, if that is not the default one."""
        return self.name if self.prefix == DEFAULT_PREFIX else f"{self.name} of {self.prefix}"


async def find_prefixes(client: EtcdClient) -> list[str]:
    """Return the prefixes of all engines in an etcd, in their order. Rows of their tables are not read.

    Raises:
        EtcdError: etcd does not answer, or refused.
    """
    found: list[str] = []
    after = ""
    while keys := (await client.range("/", after=after, limit=_PAGE, keys_only=True)).records:
        for record in keys:
            after = record.key
            if found and after.startswith(tables := Keys(found[-1]).tables):
                after = tables.removesuffix("/") + _AFTER_SLASH
                break
            if after.endswith(_SCHEMA):
                found.append(after.removesuffix(_SCHEMA))
    return found


async def known_masters(client: EtcdClient) -> list[EngineMaster]:
    """Return the masters of all engines in an etcd.

    Raises:
        StoreError: etcd does not answer, refused, or a key was overwritten.
    """
    found = []
    for prefix in await find_prefixes(client):
        keys = Keys(prefix)
        for record in (await client.range(keys.masters)).records:
            master = read_master(keys, record)
            found.append(EngineMaster(master.name, urlsplit(master.url).hostname or "", prefix))
    return found


async def forget_masters(client: EtcdClient, masters: Iterable[EngineMaster]) -> None:
    """Remove what etcd knows of masters, so that packages do not wait for them.

    Raises:
        EtcdError: etcd does not answer, or refused.
    """
    operations = [
        Delete(folder + master.name)
        for master in masters
        for folder in (Keys(master.prefix).masters, Keys(master.prefix).drained)
    ]
    if operations:
        await client.transact([], operations)
