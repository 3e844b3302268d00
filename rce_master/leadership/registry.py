"""The masters of an engine, as etcd knows them: each writes its own key, which outlives it by a day."""

from __future__ import annotations

import asyncio
import logging
from operator import attrgetter
from typing import TYPE_CHECKING

from rce_master.exceptions import MasterError, StoreError
from rce_master.store.etcd.layout import Keys, read_master, write_master
from rce_master.store.etcd.wire import Condition, Put, Subject

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from rce_master.store.etcd.client import EtcdClient
    from rce_master.store.etcd.layout import OtherMaster
    from rce_master.store.etcd.wire import Record

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
        self._own_urls: set[str] = set()
        self._lease = 0
        """One for all attempts: each that was granted stays for a day."""
        self._revision = 0
        """Of this master's key, as it was found or written last; 0: there was none."""
        self._written = ""
        """What this master's key holds by its lease; empty: it has to be written."""
        self._changed = asyncio.Event()

    async def check_name(self, client: EtcdClient, answers: Callable[[OtherMaster], Awaitable[bool]]) -> None:
        """Check that no running master has this one's name; call it before this one listens.

        Two masters of one name would be counted as one, and less than a majority would be taken for one.

        Args:
            client: Asks etcd, with the patience of a program that starts.
            answers: Tells whether a master runs at an address.

        Raises:
            MasterError: One has.
            StoreError: etcd cannot be asked.
        """
        record = await client.get(self._keys.masters + self._name)
        if record is None:
            return
        other = read_master(self._keys, record)
        if await answers(other):
            raise MasterError(_taken(other))
        self._revision = record.modified

    def announce(self, url: str) -> None:
        """Say where other masters reach this one; :meth:`run` writes it."""
        if url != self._url:
            self._url = url
            self._own_urls.add(url)
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
        url, key = self._url, self._keys.masters + self._name
        # It is read each time: operators remove the keys of machines that they take out of a cluster.
        record = await self._client.get(key)
        if record is None or record.modified != self._revision:
            self._note_found(record)
            self._written = ""
        is_kept = bool(self._lease and await self._client.renew(self._lease))
        if is_kept and self._written == url:
            return
        if not is_kept:
            self._lease, _ = await self._client.grant(KEPT_S)
        put = Put(key, write_master(url), self._lease)
        while True:
            unchanged = Condition(key, Subject.MODIFIED, self._revision)
            outcome = await self._client.transact([unchanged], [put], [key])
            if outcome.done:
                break
            self._note_found(next(iter(outcome.found), None))
        self._revision, self._written = outcome.revision, url

    def _note_found(self, record: Record | None) -> None:
        """Note the key of this master, which is not as it was.

        It ended or was removed, an earlier attempt was done after all, or another master was started
        meanwhile.

        Raises:
            StoreError: Another one has the name.
        """
        self._revision = 0
        if record is None:
            return
        if (other := read_master(self._keys, record)).url not in self._own_urls:
            raise StoreError(_taken(other))
        self._revision = record.modified

    async def others(self) -> Sequence[OtherMaster]:
        """Return the other masters, also those that are down, each by its newest name.

        Raises:
            StoreError: etcd cannot be asked.
        """
        records = (await self._client.range(self._keys.masters)).records
        found = [read_master(self._keys, one) for one in sorted(records, key=attrgetter("modified"))]
        by_url = {master.url: master for master in found if master.name != self._name}
        return [master for url, master in by_url.items() if url != self._url]


def _taken(other: OtherMaster) -> str:
    return (
        f"another master, at {other.url}, has the name {other.name} too: give each machine a name of its own,"
        " by its host name or --machine"
    )
