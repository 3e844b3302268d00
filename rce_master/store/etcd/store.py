"""The store in etcd: each save is one transaction, which the leader key and a save number fence.

The keys are those of :mod:`rce_master.store.etcd.layout`.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_master.exceptions import FencedError, SaveTooLargeError, StaleTermError, StoreBusyError, StoreError
from rce_master.store.etcd.client import LOAD_S
from rce_master.store.etcd.exceptions import (
    NO_SPACE,
    NO_SPACE_ALARM,
    OUT_OF_RANGE,
    EtcdAwayError,
    EtcdRefusedError,
    with_remedy,
)
from rce_master.store.etcd.layout import (
    Keys,
    LeadershipView,
    read_leader,
    read_mark,
    read_term,
    write_number,
)
from rce_master.store.etcd.wire import Condition, Delete, Put, Record, Subject

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce_master.store.base import Row, Snapshot
    from rce_master.store.etcd.client import EtcdClient
    from rce_master.store.etcd.wire import Outcome, Page

PAGE_ROWS = 500
REPEAT_S = 10.0
"""How long a write without a lease is repeated while etcd does not answer."""
_PAUSE_S = 0.05
_ATTEMPTS = 10
"""To begin a term, while others begin terms too."""


@dataclass(frozen=True, slots=True)
class Candidacy:
    """Under which a master takes the lead.

    Attributes:
        lease: The leader key lives as long as this lease.
        name: The master's name.
        remaining: Seconds until this master has to give up; a write whose outcome is unknown is repeated for
            so long.
    """

    lease: int
    name: str
    remaining: Callable[[], float]
    url: str = ""
    """Where other masters reach this one."""


class EtcdStore:
    """A store below a prefix of an etcd that :func:`prepare` has accepted.

    With a candidacy it belongs to one leadership: what it writes after the lease has ended, or after another
    store began a term, is refused. Without one it is for programs that work while no master leads.

    Args:
        client: Connected to etcd; the caller closes it.
        prefix: How all keys begin.
        candidacy: The lease to lead by; None takes no lead, and begins no term while a master leads.
    """

    def __init__(self, client: EtcdClient, prefix: str, candidacy: Candidacy | None = None) -> None:
        self._client = client
        self._keys = Keys(prefix)
        self._candidacy = candidacy
        self._term = 0
        self._begun = 0
        """The revision at which the term was begun; 0: none was ever."""
        self._led = 0
        """The revision at which the leader key was created; 0: it must not exist."""
        self._last: bytes | None = None
        """What the key of the last save holds; None: it does not exist."""
        self._is_in_doubt = False
        """Whether it is unknown if the last save was done."""

    async def load(self) -> Snapshot:
        """Read everything, as it was at one moment.

        Raises:
            StoreError: It cannot be read.
        """
        return (await load_rows(self._client, self._keys))[0]

    @property
    def begun(self) -> int:
        """The revision at which this store's term was begun."""
        return self._begun

    async def leadership(self) -> LeadershipView:
        """Tell which master leads, and what stand-bys need to know.

        Raises:
            StoreError: etcd cannot be asked.
        """
        keys = self._keys
        there = {record.key: record for record in await self._read_leadership()}
        leader, last = there.get(keys.leader), there.get(keys.last)
        return LeadershipView(
            leader=None if leader is None else read_leader(leader),
            drained=frozenset(
                key.removeprefix(keys.drained) for key in there if key.startswith(keys.drained)
            ),
            last=0 if last is None else last.modified,
        )

    async def newest_term(self) -> int:
        """Tell the newest term that any master began; 0: none.

        Raises:
            StoreError: etcd cannot be asked.
        """
        found = await self._client.get(self._keys.term)
        return 0 if found is None else read_term(found)

    async def holds_lead(self) -> bool:
        """Tell whether the leader key is still the one of this store's term.

        Raises:
            StoreError: etcd cannot be asked.
        """
        found = await self._client.get(self._keys.leader)
        return found is not None and found.created == self._led

    async def begin_term(self, *, above: int = 0) -> int:
        """Begin a new term, greater than another one too, and with a candidacy take the lead.

        Raises:
            StoreBusyError: Another master leads.
            StoreError: None was begun, or etcd does not tell.
        """
        mark = secrets.token_hex(8)
        for _ in range(_ATTEMPTS):
            there = {record.key: record for record in await self._read_leadership()}
            leader, newest = there.get(self._keys.leader), there.get(self._keys.term)
            if newest is not None and read_mark(newest) == mark:  # by an attempt without an answer
                return self._began(newest, leader)
            if leader is not None and leader.created != self._led:
                raise StoreBusyError(f"another master leads: {read_leader(leader).name}")
            try:
                await self._try_term(mark, newest, above)
            except EtcdAwayError as error:
                if not error.maybe_done:
                    raise
        raise StoreError("no term could be begun: others begin terms, or etcd does not answer")

    async def _read_leadership(self) -> Sequence[Record]:
        return (await self._client.range(self._keys.leadership)).records

    async def _try_term(self, mark: str, newest: Record | None, above: int) -> None:
        term = max(above, 0 if newest is None else read_term(newest)) + 1
        conditions = [
            Condition(self._keys.term, Subject.MODIFIED, 0 if newest is None else newest.modified),
            Condition(self._keys.leader, Subject.CREATED, self._led),
        ]
        operations = [
            Put(self._keys.term, json.dumps({"term": term, "mark": mark}).encode()),
            Put(self._keys.last, write_number(term, 0)),
        ]
        if self._candidacy is not None and not self._led:
            own = self._candidacy
            value = json.dumps({"name": own.name, "term": term, "url": own.url}).encode()
            operations.append(Put(self._keys.leader, value, self._candidacy.lease))
        await self._client.transact(conditions, operations)

    def _began(self, newest: Record, leader: Record | None) -> int:
        if self._candidacy is not None:
            if leader is None or leader.lease != self._candidacy.lease:
                raise FencedError("the lease ended while this master took the lead")
            self._led = leader.created
        self._term, self._begun = read_term(newest), newest.modified
        self._last, self._is_in_doubt = write_number(self._term, 0), False
        return self._term

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        """Write rows in one transaction.

        While its outcome is unknown it is repeated; it is done once at most. Being cancelled leaves it
        unknown, and nothing more can be saved in this term.

        Raises:
            SaveTooLargeError: It exceeds what etcd takes in one request; nothing was written.
            StaleTermError: A newer term was begun.
            FencedError: The lease has ended, and it may have been written or not.
            StoreError: Nothing was written.
        """
        if term < self._term:
            raise StaleTermError(term, self._term)
        if self._is_in_doubt:
            raise FencedError("it is not known whether the last save was stored; this master leads no more")
        number = 1 if self._last is None else int(self._last.partition(b":")[2]) + 1
        now = write_number(self._term, number)
        newest = {self._keys.row(row.table, row.key): row.body for row in rows}
        operations = [Delete(key) if body is None else Put(key, body) for key, body in newest.items()]
        self._is_in_doubt = True
        try:
            outcome = await self._repeat([*operations, Put(self._keys.last, now)])
        except FencedError:
            raise
        except StoreError as error:
            self._is_in_doubt = False
            if isinstance(error, EtcdRefusedError) and error.is_too_large:
                raise SaveTooLargeError(str(error)) from error
            raise
        if not outcome.done:
            self._find_out(outcome, now)
        self._last, self._is_in_doubt = now, False

    async def _repeat(self, operations: Sequence[Put | Delete]) -> Outcome:
        """Ask for a save until etcd tells what became of it."""
        keys, last = self._keys, self._last
        conditions = [
            Condition(keys.leader, Subject.CREATED, self._led),
            Condition(keys.term, Subject.MODIFIED, self._begun),
            Condition(keys.last, Subject.CREATED, 0)
            if last is None
            else Condition(keys.last, Subject.VALUE, last),
        ]
        remaining = _countdown() if self._candidacy is None else self._candidacy.remaining
        maybe_done = False
        while True:
            try:
                return await self._client.transact(
                    conditions, operations, [keys.leader, keys.term, keys.last]
                )
            except EtcdRefusedError as error:
                if not maybe_done:
                    raise
                failure: StoreError = error
            except EtcdAwayError as error:
                maybe_done = maybe_done or error.maybe_done
                failure = error
            if remaining() <= 0:
                if maybe_done:
                    raise FencedError(f"it is not known whether a save was stored: {failure}") from failure
                raise failure
            await asyncio.sleep(_PAUSE_S)

    def _find_out(self, outcome: Outcome, now: bytes) -> None:
        """Return if an earlier attempt of a save was done.

        Raises:
            FencedError: It was not, and can never be.
        """
        there = {record.key: record for record in outcome.found}
        last = there.get(self._keys.last)
        if last is not None and last.value == now:
            return
        newest = there.get(self._keys.term)
        if newest is not None and newest.modified != self._begun:
            raise StaleTermError(self._term, read_term(newest))
        leader = there.get(self._keys.leader)
        if (0 if leader is None else leader.created) != self._led:
            raise FencedError("the lease of this master's leadership has ended")
        found = "none" if last is None else last.value.decode(errors="replace")
        raise FencedError(f"another program writes below {self._keys.root}: the last save is {found}")

    async def check(self) -> None:
        """Check that a majority of etcd's members answers, and that etcd takes writes.

        Raises:
            StoreError: It does not.
        """
        try:
            found = await self._client.get(self._keys.schema)
            faults = await self._client.faults()
        except EtcdAwayError as error:
            raise StoreError(with_remedy(error)) from error
        if found is None:
            raise StoreError(f"the state below {self._keys.root} was removed from etcd")
        if any(NO_SPACE_ALARM in fault for fault in faults):
            raise StoreError(NO_SPACE)

    async def close(self) -> None:
        """Nothing to let go of: the client is the caller's."""


async def load_rows(client: EtcdClient, keys: Keys) -> tuple[Snapshot, int]:
    """Read all rows as they were at one moment; return them and its revision.

    Raises:
        StoreError: They cannot be read.
    """
    while True:
        try:
            return await _load_pages(client, keys)
        except EtcdRefusedError as error:
            if error.fault.code != OUT_OF_RANGE:  # compacted away while it was read
                raise


async def _load_pages(client: EtcdClient, keys: Keys) -> tuple[Snapshot, int]:
    tables: dict[str, dict[str, bytes]] = {}
    page: Page | None = None
    revision = 0
    while page is None or page.more:
        after = "" if page is None else page.records[-1].key
        page = await client.range(
            keys.tables, after=after, limit=PAGE_ROWS, revision=revision, timeout=LOAD_S
        )
        revision = revision or page.revision
        for record in page.records:
            table, key = keys.read_row(record.key)
            tables.setdefault(table, {})[key] = record.value
    return tables, revision


def _countdown() -> Callable[[], float]:
    end = time.monotonic() + REPEAT_S
    return lambda: end - time.monotonic()
