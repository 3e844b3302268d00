"""Waits for the lead, keeps it by renewing a lease at etcd, and gives it back."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from typing import TYPE_CHECKING

from rce_master.exceptions import FencedError, StoreBusyError, StoreError
from rce_master.leadership.core import Fence, LeadershipCore, LeaseSettings, Role
from rce_master.store.etcd.exceptions import with_remedy
from rce_master.store.etcd.store import Candidacy, EtcdStore

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_master.store.etcd.client import EtcdClient
    from rce_master.store.etcd.layout import Leader

_log = logging.getLogger(__name__)

_PAUSE_S = 0.1
"""Between two attempts of a renewal."""


def boot_time() -> float:
    """Return seconds since the start of the machine, also those in which it was suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class LeadershipKeeper:
    """The leadership of one master: :meth:`acquire`, then :meth:`keep`, then :meth:`step_down`, and again.

    :meth:`resign` begins the last of them.

    Args:
        client: Connected to etcd.
        prefix: Of the state's keys.
        name: This master's name, for the others.
        settings: Times.
        clock: Seconds that also pass while the machine is suspended.

    Attributes:
        core: The role, the term and the deadline.
        leader: The leading master, as far as this one knows.
        fault: Why etcd cannot be asked, or gives no lease while no master leads; empty if neither.
        url: Where other masters reach this one while it leads.
        lease: The number of the lease by which this master leads; 0: it has none.
        is_drained: Whether this master is drained, as a stand-by saw it last.
        on_save: Called by a stand-by with the revision of the last save that it sees.
        on_look: Called by a stand-by with the term of the leading master when it has looked; 0: none leads.
        is_watched: Tells a stand-by whether :meth:`wake` is called when the leadership changes.
    """

    def __init__(
        self,
        client: EtcdClient,
        prefix: str,
        name: str,
        settings: LeaseSettings | None = None,
        clock: Callable[[], float] = boot_time,
    ) -> None:
        self._client = client
        self._prefix = prefix
        self._name = name
        self._clock = clock
        self._watched = EtcdStore(client, prefix)
        self._store: EtcdStore | None = None
        self.url = ""
        self.lease = 0
        self.core = LeadershipCore(settings or LeaseSettings())
        self.leader: Leader | None = None
        self.fault = ""
        self._refusal = ""
        """Why the last request for a lease failed; a look at etcd can succeed meanwhile."""
        self.is_drained = False
        self.on_save: Callable[[int], None] | None = None
        self.on_look: Callable[[int], None] = lambda _: None
        self.is_watched: Callable[[], bool] = lambda: False
        self._woken = asyncio.Event()
        self._ending: asyncio.Task[None] | None = None
        """Gives the lease back."""

    def wake(self) -> None:
        """Let a stand-by look at etcd now: the leadership has changed, or is not watched any more."""
        self._woken.set()

    def newest_term(self) -> int:
        """Return the newest term that this master knows; 0: none."""
        return 0 if self.leader is None else self.leader.term

    async def acquire(self) -> tuple[EtcdStore, Fence]:
        """Wait until no other master leads, and take the lead; a drained master waits longer.

        Cancelling gives a lease back that was taken meanwhile.

        Returns:
            The store of the new term, and what tells whether it still lasts.
        """
        while True:
            self._woken.clear()
            if await self._look() and await self._campaign():
                assert self._store is not None
                return self._store, Fence(self.core, self._clock, self._name)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._pause()):
                    await self._woken.wait()

    def _pause(self) -> float:
        """Return the longest time until the next look, seconds."""
        settings = self.core.settings
        knows = self.leader is not None and not self.fault
        return settings.watched_poll if knows and self.is_watched() else settings.poll

    async def _look(self) -> bool:
        """Look at etcd; return whether to try to take the lead."""
        try:
            seen = await self._watched.leadership()
        except StoreError as error:
            self._note(with_remedy(error))
            return self.core.looked(is_led=None, is_drained=self.is_drained, now=self._clock())
        self.leader, self.is_drained = seen.leader, self._name in seen.drained
        if self.leader is not None:
            self._refusal = ""
        self._note(self._refusal)
        self.on_look(self.newest_term())
        if self.on_save is not None:
            self.on_save(seen.last)
        return self.core.looked(is_led=self.leader is not None, is_drained=self.is_drained, now=self._clock())

    async def _campaign(self) -> bool:
        sent = self._clock()
        try:
            self.lease, ttl = await self._client.grant(math.ceil(self.core.settings.ttl))
        except StoreError as error:
            self._refusal = with_remedy(error)
            self._note(self._refusal)
            return False
        self._refusal = ""
        self._note("")
        self.core.granted(sent, ttl)
        candidacy = Candidacy(self.lease, self._name, self._remaining, self.url)
        store = EtcdStore(self._client, self._prefix, candidacy)
        try:
            async with asyncio.timeout(max(0.0, self._remaining())):
                term = await store.begin_term(above=self.core.heard)
            self.core.elected(term, self._clock())
        except StoreBusyError:
            _log.info("another master was faster to take the lead")
        except (StoreError, TimeoutError) as error:
            _log.warning("the lead could not be taken: %s", str(error) or "etcd does not answer")
        finally:
            if self.core.role is not Role.LEADING:
                await self._give_up()
        self._store = store
        return self.core.role is Role.LEADING

    async def _give_up(self) -> None:
        if self.core.role is Role.CANDIDATE:
            self.core.refused()
        await self._revoke()

    async def keep(self) -> None:
        """Renew the lease until it is lost.

        Raises:
            FencedError: It is lost.
        """
        while self.core.look(self._clock()):
            await asyncio.sleep(self.core.until_renewal(self._clock()))
            if self.core.look(self._clock()) and not await self._renew():
                await asyncio.sleep(_PAUSE_S)
        raise FencedError("the lease was lost, or could not be renewed in time")

    async def _renew(self) -> bool:
        """Renew the lease once; return False if etcd did not answer."""
        assert self._store is not None
        sent = self._clock()
        try:
            async with asyncio.timeout(max(0.0, self._remaining())):
                ttl = await self._client.renew(self.lease)
                # A renewal does not prove it: etcd before 3.4.27 may renew a lease that has ended.
                holds = await self._store.holds_lead()
        except TimeoutError:
            return False
        except StoreError as error:
            _log.warning("the lease was not renewed: %s", error)
            return False
        if holds:
            self.core.renewed(sent, ttl)
        else:
            self.core.lost()
        return True

    def resign(self) -> None:
        """Begin to hand over: the fence is closed, and the lease ends, so that another master leads at once.

        What is left of the term may be let go of meanwhile. Nothing happens a second time.
        """
        self.core.resigned()
        if self._ending is None:
            self._ending = asyncio.create_task(self._revoke(), name="give the lease back")

    async def step_down(self) -> None:
        """End the lease, if that has not begun, and become a stand-by; nothing of the term may be left."""
        self.resign()
        assert self._ending is not None
        await self._ending
        self._ending = None
        self.core.released()
        self._store = None

    async def _revoke(self) -> None:
        lease, self.lease = self.lease, 0
        if not lease:
            return
        try:
            await self._client.revoke(lease, timeout=self.core.settings.revocation)
        except StoreError as error:
            _log.info("the lease is left to end by itself: %s", error)

    def _remaining(self) -> float:
        return self.core.remaining(self._clock())

    def _note(self, fault: str) -> None:
        if fault and not self.fault:
            _log.warning("%s", fault)
        self.fault = fault
