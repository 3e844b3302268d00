"""A stand-by's copy of the state: loaded once, then kept by a watch; a takeover loads differences only.

What the watch delivers is a help, not a proof: releases of etcd have lost events. The copy is as of a
revision that was *verified*, and events since. To verify it, etcd is asked for the rows that were written
after the last verified revision, and for the number of all rows. Together they prove the copy: each row that
was not written since is as it was, each one that was written is in the answer, and if the numbers are equal,
none is left that was removed.
"""

from __future__ import annotations

import asyncio
import gc
import logging
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce.aio.backoff import Backoff
from rce_master.exceptions import StoreError
from rce_master.state.core import State, without_collections
from rce_master.state.migration import conversion
from rce_master.store.copying import check_finished
from rce_master.store.etcd.client import LOAD_S
from rce_master.store.etcd.exceptions import EtcdAwayError
from rce_master.store.etcd.layout import Keys
from rce_master.store.etcd.store import load_rows

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from rce_master.state.settings import StateSettings
    from rce_master.store.etcd.client import EtcdClient, Watch
    from rce_master.store.etcd.wire import Watched

_log = logging.getLogger(__name__)

VERIFY_S = 60.0
"""Time from one check of the copy to the next; a takeover checks what was written since."""
STALLED_S = 3.0
"""How long the copy may be behind until another member of etcd is watched."""
CATCH_UP_S = 1.0
"""How long a takeover waits for the events before it."""
TRUSTED_S = 1.0
"""How long the copy may be behind until the watch is not relied on to tell of a change of the lead."""
_PAUSE_S = 1.0
_RELOAD = Backoff(first=1.0, longest=60.0)


@dataclass(slots=True)
class Lag:
    """How far a copy is behind the last save that is known. Pure; times are seconds of any clock.

    Attributes:
        applied: The revision of the last save that the copy has.
        newest: That of the last save at etcd.
    """

    applied: int = 0
    newest: int = 0
    _since: float | None = field(default=None)

    def saw(self, newest: int, now: float) -> None:
        """Note the last save at etcd."""
        self.newest = max(self.newest, newest)
        self._look(now)

    def has(self, applied: int, now: float) -> None:
        """Note the last save that the copy has; 0: there is no copy."""
        self.applied = applied
        self._look(now)

    @property
    def revisions(self) -> int:
        """Revisions of etcd that the copy is behind."""
        return max(0, self.newest - self.applied)

    def seconds(self, now: float) -> float:
        """Tell for how long it is behind; 0: it is not."""
        return 0.0 if self._since is None else now - self._since

    def _look(self, now: float) -> None:
        if self.applied >= self.newest:
            self._since = None
        elif self._since is None:
            self._since = now


class _GapError(Exception):
    """The copy cannot be continued, and has to be loaded anew."""


class StateFollower:
    """Follows the state that another master writes.

    Args:
        client: Connected to etcd.
        prefix: Of the state's keys.
        settings: Of the state.
        clock: Seconds that never go back.

    Attributes:
        lag: How far the copy is behind.
        loads: How often the whole state was loaded.
        on_leadership: Called when the watch tells of a change of the lead or of the drains, and when it ends.
    """

    def __init__(
        self, client: EtcdClient, prefix: str, settings: StateSettings | None, clock: Callable[[], float]
    ) -> None:
        self._client = client
        self._keys = Keys(prefix)
        self._settings = settings
        self._clock = clock
        self._state: State | None = None
        self._unknown: set[str] = set()
        """Keys of tables that this release does not know."""
        self._verified = 0
        """The revision at which the copy was as etcd's rows."""
        self._watched = 0
        """The revision of the last event."""
        self._read = 0
        """Rows that the last check read."""
        self._event = asyncio.Event()
        self._is_taken = False
        self._watch: Watch | None = None
        self.lag = Lag()
        self.loads = 0
        self.on_leadership: Callable[[], None] = lambda: None

    async def run(self) -> None:
        """Follow until cancelled, or until the copy is taken."""
        level, pauses = logging.WARNING, _RELOAD.start()
        while not self._is_taken:
            try:
                await self._load()
                level, pauses = logging.WARNING, _RELOAD.start()
                while self._state is not None:
                    await self._follow_a_member()
            except (StoreError, _GapError) as error:
                _log.log(level, "this stand-by loads its copy of the state anew: %s", error)
                level = logging.DEBUG
            self._drop()
            await asyncio.sleep(pauses.next())

    @property
    def is_watching(self) -> bool:
        """Whether a watch tells of changes, at the member of etcd that answers requests."""
        there = self._watch is not None and self._client.uses(self._watch)
        return there and self.seconds_behind < TRUSTED_S

    @property
    def seconds_behind(self) -> float:
        """For how long the copy is behind; 0: it is not."""
        return self.lag.seconds(self._clock())

    def saw(self, newest: int) -> None:
        """Note the revision of the last save at etcd."""
        self.lag.saw(newest, self._clock())

    async def take(self, revision: int) -> State | None:
        """Give the copy away, as the state is now; :meth:`run` must still run.

        Args:
            revision: That of a write of this master, after which no other one can write.

        Returns:
            None if there is no copy, or it is not as etcd's rows.
        """
        try:
            async with asyncio.timeout(CATCH_UP_S):
                while self._watched < revision and self._watch is not None:
                    self._event.clear()
                    await self._event.wait()
        except TimeoutError:
            _log.info("the watch of the state is behind; what it missed is read")
        state, self._is_taken = self._state, True
        try:
            if state is not None:
                await self._verify(state)
        except (StoreError, _GapError) as error:
            _log.warning("the copy of the state cannot be used, and it is loaded: %s", error)
            return None
        finally:
            self._drop()
        if state is not None:
            _log.info("the state was followed: of %d rows, %d were read now", state.rows, self._read)
        return state

    async def _load(self) -> None:
        snapshot, revision = await load_rows(self._client, self._keys)
        check_finished(snapshot)
        if conversion(snapshot):
            raise _GapError("a master of this release has to convert it first")
        state = State(self._settings)
        with without_collections():
            for _ in state.reading(snapshot):
                await asyncio.sleep(0)
        known = {table.name for table in state.tables.all if table.persistent}
        self._unknown = {
            self._keys.row(name, key) for name, rows in snapshot.items() if name not in known for key in rows
        }
        gc.collect()
        gc.freeze()
        self._state, self._verified, self._watched = state, revision, revision
        self.loads += 1
        self.lag.has(revision, self._clock())

    def _drop(self) -> None:
        self._state = None
        self._event.set()
        gc.unfreeze()
        self.lag.has(0, self._clock())

    async def _follow_a_member(self) -> None:
        try:
            await self._follow()
        except EtcdAwayError as error:
            _log.debug("the state is followed at another member of etcd: %s", error)
            await asyncio.sleep(_PAUSE_S)

    async def _follow(self) -> None:
        """Watch one member of etcd until it is behind, or the copy is taken.

        Raises:
            EtcdAwayError: It ended the watch, or does not answer.
            StoreError: A row cannot be read.
            _GapError: The copy cannot be continued.
        """
        state = self._state
        if state is None:
            return
        began = self._clock()
        check_at = began + VERIFY_S
        async with self._watching() as watch:
            while self._state is state:
                seen = await watch.next(_PAUSE_S)
                if seen is not None:
                    if seen.compacted:
                        raise _GapError("etcd has compacted what it missed")
                    self._apply(state, seen)
                now = self._clock()
                if self.lag.seconds(now) > STALLED_S and now - began > STALLED_S:
                    watch.give_up()
                    return
                if not self._client.uses(watch):
                    await asyncio.sleep(_PAUSE_S)  # the next watch may be passed over as soon
                    return
                if now >= check_at:
                    await self._verify(state)
                    check_at = now + VERIFY_S

    @asynccontextmanager
    async def _watching(self) -> AsyncIterator[Watch]:
        async with self._client.watch(self._keys.root, self._watched + 1) as watch:
            self._watch = watch
            try:
                yield watch
            finally:
                self._watch = None
                self._event.set()
                self.on_leadership()

    def _apply(self, state: State, seen: Watched) -> None:
        for change in seen.changes:
            if change.key == self._keys.last:
                self.lag.has(change.revision, self._clock())
            elif change.key == self._keys.leader or change.key.startswith(self._keys.drained):
                self.on_leadership()
            elif change.key.startswith(self._keys.tables) and change.revision > self._verified:
                self._assign(state, change.key, change.value)
        if seen.revision > self._watched:
            self._watched = seen.revision
            self._event.set()

    def _assign(self, state: State, key: str, body: bytes | None) -> None:
        table, row = self._keys.read_row(key)
        if not state.write_row(table, row, body):
            if body is None:
                self._unknown.discard(key)
            else:
                self._unknown.add(key)

    async def _verify(self, state: State) -> None:
        """Make the copy as etcd's rows are now.

        Raises:
            _GapError: It is not.
            StoreError: etcd cannot be asked.
        """
        page = await self._client.range(self._keys.tables, written_after=self._verified, timeout=LOAD_S)
        self._read = len(page.records)
        for record in sorted(page.records, key=lambda one: one.modified):
            self._assign(state, record.key, record.value)
        self._verified = page.revision
        if state.rows + len(self._unknown) != page.count:
            # Removals whose events are on their way, or were lost.
            keys = await self._client.range(
                self._keys.tables, revision=page.revision, keys_only=True, timeout=LOAD_S
            )
            there = {record.key for record in keys.records}
            for key in {*self._held(state), *self._unknown} - there:
                self._assign(state, key, None)
            if state.rows + len(self._unknown) != len(there):
                raise _GapError("it lacks rows")

    def _held(self, state: State) -> Iterable[str]:
        for table in state.tables.all:
            if table.persistent:
                yield from (self._keys.row(table.name, table.key(record)) for record in table)
