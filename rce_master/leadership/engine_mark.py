"""Marks a prefix of etcd as that of one engine, so that another engine does not take its masters for its own.

Engines differ by their secrets. The mark is a keyed hash of each secret that the leading master accepts; it
follows the secret when that is rotated.
"""

from __future__ import annotations

import asyncio
import json
import logging
from typing import TYPE_CHECKING

from rce_master.exceptions import StoreError
from rce_master.store.etcd.layout import Keys
from rce_master.store.etcd.wire import Condition, Put, Record, Subject

if TYPE_CHECKING:
    from rce.config import Secret
    from rce_master.store.etcd.client import EtcdClient

_log = logging.getLogger(__name__)

PURPOSE = "mark of an engine"
"""Of the keys that are derived from the engine's secrets."""
LOOK_S = 60.0
_LENGTH = 16


class EngineMark:
    """The mark below a prefix.

    Args:
        client: Connected to etcd.
        prefix: Of the engine's keys.
        secret: The engine's.
    """

    def __init__(self, client: EtcdClient, prefix: str, secret: Secret) -> None:
        self._client = client
        self._keys = Keys(prefix)
        self._secret = secret

    async def check(self) -> None:
        """Check that the prefix is this engine's; mark one that has no mark.

        Raises:
            StoreError: It is another engine's, or etcd cannot be used.
        """
        found = await self._client.get(self._keys.engine)
        if found is None:
            await self._write(0)
            found = await self._client.get(self._keys.engine)
        if found is not None and not set(_read(found)) & set(self._own()):
            raise StoreError(
                f"below {self._keys.root} of etcd is the state of another engine, which has another secret;"
                " choose another prefix (etcd://HOST:2379/PREFIX), or copy that engine's secret to this"
                f" machine. If its secret was replaced while no master ran: etcdctl del {self._keys.engine}"
            )

    async def run(self) -> None:
        """Let the mark follow the secret, until cancelled; for the leading master."""
        while True:
            try:
                found = await self._client.get(self._keys.engine)
                if found is None or _read(found) != self._own():
                    await self._write(0 if found is None else found.modified)
            except StoreError as error:
                _log.debug("the mark of the engine cannot be kept: %s", error)
            await asyncio.sleep(LOOK_S)

    async def _write(self, modified: int) -> None:
        value = json.dumps({"secrets": self._own()}).encode()
        unchanged = Condition(self._keys.engine, Subject.MODIFIED, modified)
        await self._client.transact([unchanged], [Put(self._keys.engine, value)])

    def _own(self) -> list[str]:
        return [key.hex()[:_LENGTH] for key in self._secret.derive_all(PURPOSE)]


def _read(record: Record) -> list[str]:
    try:
        return [str(mark) for mark in json.loads(record.value)["secrets"]]
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"the key {record.key} of etcd was overwritten") from error
