"""Masters that are drained: they hand the lead over, and take it only if no other master does.

The leading master writes the mark of a drain to etcd, where every master reads it. A drained leader hands
over as soon as a stand-by that is not drained works: if there is none, it continues.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_master.exceptions import FencedError, StoreError
from rce_master.store.etcd.layout import Keys
from rce_master.store.etcd.wire import Delete, Put

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from rce_master.leadership.registry import MasterRegistry
    from rce_master.store.etcd.client import EtcdClient
    from rce_master.store.etcd.layout import OtherMaster

_log = logging.getLogger(__name__)

LOOK_S = 2.0
"""Time from one look of a drained leader to the next, for a stand-by that can lead; and after a failure."""
RARE_LOOK_S = 30.0
"""The same of a leader that is not drained: drains go by its own REST API, which makes it look at once."""


@dataclass(frozen=True, slots=True)
class KnownMaster:
    """A master of the engine."""

    name: str
    url: str
    drained: bool
    role: str
    """``leader``, ``standby``, or ``away``: it does not answer."""


class MasterDrains:
    """The drains of all masters, for the leading one.

    Args:
        client: Connected to etcd.
        prefix: Of the state's keys.
        name: This master's name.
        registry: Knows the other masters.
        ask: Tells whether another master is a stand-by that works.

    Attributes:
        is_drained: Whether this master is drained, as it saw it last.
    """

    def __init__(
        self,
        client: EtcdClient,
        prefix: str,
        name: str,
        registry: MasterRegistry,
        ask: Callable[[OtherMaster], Awaitable[bool]],
    ) -> None:
        self._client = client
        self._keys = Keys(prefix)
        self._name = name
        self._registry = registry
        self._ask = ask
        self._changed = asyncio.Event()
        self.is_drained = False

    async def masters(self) -> list[KnownMaster]:
        """Return all masters that etcd knows, this one first.

        Raises:
            StoreError: etcd cannot be asked.
        """
        drained = await self._drained()
        others = await self._registry.others()
        work = await asyncio.gather(*(self._ask(other) for other in others))
        found = [KnownMaster(self._name, self._registry.url, self._name in drained, "leader")]
        for other, works in zip(others, work, strict=True):
            role = "standby" if works else "away"
            found.append(KnownMaster(other.name, other.url, other.name in drained, role))
        return found

    async def find(self, name: str, *, by_machine: bool) -> str:
        """Return the full name of a master; empty: there is none of this name.

        Args:
            name: ``MACHINE:PORT``.
            by_machine: Whether the machine is enough, if it has one master.

        Raises:
            StoreError: etcd cannot be asked.
        """
        names = {self._name, *(other.name for other in await self._registry.others()), *await self._drained()}
        if name in names:
            return name
        there = [one for one in names if by_machine and one.rpartition(":")[0] == name]
        return there[0] if len(there) == 1 else ""

    async def set_drained(self, name: str, *, drained: bool) -> None:
        """Drain a master, or cancel that.

        Raises:
            StoreError: etcd did not take it, or does not tell.
        """
        key = self._keys.drained + name
        try:
            await self._client.transact([], [Put(key, b"{}") if drained else Delete(key)])
        finally:  # without an answer it may have been done
            self._changed.set()

    async def run(self) -> None:
        """Look at the drains, until cancelled.

        Raises:
            FencedError: This master is drained, and another one can lead.
        """
        while True:
            self._changed.clear()
            pause = LOOK_S
            try:
                await self._look()
                pause = LOOK_S if self.is_drained else RARE_LOOK_S
            except StoreError as error:
                if isinstance(error, FencedError):
                    raise
                _log.debug("the drains of masters cannot be read: %s", error)
            try:
                async with asyncio.timeout(pause):
                    await self._changed.wait()
            except TimeoutError:
                continue

    async def _look(self) -> None:
        drained = await self._drained()
        self.is_drained = self._name in drained
        if not self.is_drained:
            return
        others: Sequence[OtherMaster] = [
            one for one in await self._registry.others() if one.name not in drained
        ]
        if any(await asyncio.gather(*(self._ask(other) for other in others))):
            raise FencedError("it is drained, and another master can lead")

    async def _drained(self) -> set[str]:
        page = await self._client.range(self._keys.drained, keys_only=True)
        return {record.key.removeprefix(self._keys.drained) for record in page.records}
