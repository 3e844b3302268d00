"""The masters of an engine, as etcd knows them: each writes its own key, which outlives it by a day."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce_master.exceptions import StoreError
from rce_master.store.etcd.layout import Keys, read_master, write_master
from rce_master.store.etcd.wire import Put

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_master.store.etcd.client import EtcdClient
    from rce_master.store.etcd.layout import OtherMaster

_log = logging.getLogger(__name__)

KEPT_S = 86_400
"""How long a master counts that is down. It counts while it is away for a moment, so that a majority of the
others is one of all."""
_RENEWAL_S = 600.0
_PAUSE_S = 1.0
"""After a failure."""


class MasterRegistry:
    """Writes the key of this master, and reads those of the others.

    Args:
        client: Connected to etcd.
        prefix: Of the state's keys.
        name: This master's name.
    """

    def __init__(self, client: EtcdClient, prefix: str, name: str) -> None:
        self._client = client
        self._keys = Keys(prefix)
        self._name = name
        self._url = ""
        self._lease = 0
        self._changed = asyncio.Event()

    def announce(self, url: str) -> None:
        """Say where other masters reach this one; :meth:`run` writes it."""
        if url != self._url:
            self._url, self._lease = url, 0
            self._changed.set()

    @property
    def url(self) -> str:
        """Where other masters reach this one; empty: it was not said yet."""
        return self._url

    async def run(self) -> None:
        """Keep the key of this master, until cancelled."""
        level = logging.WARNING
        while True:
            self._changed.clear()
            pause = _RENEWAL_S
            try:
                if self._url:
                    await self._write()
                level = logging.WARNING
            except StoreError as error:
                _log.log(level, "the other masters do not get to know where this one is: %s", error)
                level, pause = logging.DEBUG, _PAUSE_S
            try:
                async with asyncio.timeout(pause):
                    await self._changed.wait()
            except TimeoutError:
                continue

    async def _write(self) -> None:
        if self._lease and await self._client.renew(self._lease):
            return
        url = self._url
        lease, _ = await self._client.grant(KEPT_S)
        await self._client.transact([], [Put(self._keys.masters + self._name, write_master(url), lease)])
        if url == self._url:
            self._lease = lease

    async def others(self) -> Sequence[OtherMaster]:
        """Return the other masters, also those that are down.

        Raises:
            StoreError: etcd cannot be asked.
        """
        records = (await self._client.range(self._keys.masters)).records
        found = [read_master(self._keys, record) for record in records]
        return [master for master in found if master.name != self._name]
