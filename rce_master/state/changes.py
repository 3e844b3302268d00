"""The changes of a command: the journal of one transaction and its effects outside the core."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec.structs import replace

from rce_master.state.records import (
    Container,
    ContainerLive,
    Counter,
    Departure,
    Drain,
    Endpoint,
    Lockout,
    Move,
    Presence,
    Robot,
    RobotLive,
    TaskSet,
    Tombstone,
)
from rce_master.state.user_records import (
    KeptAnswer,
    KnownLogin,
    PackageKey,
    Token,
    User,
    UserLimits,
    UserPackage,
)
from rce_master.state.volume_records import SavedState, UserVolume, VolumeMove, VolumeRemoval
from rce_master.state.wiring_records import ActiveInterface, Connection, Interface, Link, OpenEnd
from rce_master.store.base import Row

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_master.state.settings import StateSettings
    from rce_master.state.table import Table
    from rce_master.state.tables import Tables

R = TypeVar("R")

USER_ADDED, USER_REMOVED = "user_added", "user_removed"
"""Kinds of events that begin and end the time of a user of some name."""


@dataclass(frozen=True, slots=True)
class Withdrawal:
    """An endpoint that a task set is to drop."""

    process: str
    id: str
    revision: int
    reason: str
    elsewhere: bool = False
    """Whether it continues at another task set: a robot connects again, nodes' states are saved first."""


@dataclass(frozen=True, slots=True)
class Notice:
    """A text for a robot (``user/tag``) or for all connected robots of a user (``user``)."""

    to: str
    text: str


@dataclass(frozen=True, slots=True)
class StateEvent:
    """A message for users; becomes an event of the API."""

    kind: str
    user: str
    """Empty: of interest to administrators only."""
    subject: str
    """The object of the event, such as an endpoint id."""
    text: str


@dataclass(slots=True)
class Touched:
    """The changed parts of an endpoint's spec; the tables hold those that still exist."""

    since: int = 0
    """The endpoint's revision before."""
    contents: bool = False
    """Whether parts other than interfaces, links and connections changed (too)."""
    interfaces: dict[str, None] = field(default_factory=dict)
    """By tag."""
    links: dict[str, None] = field(default_factory=dict)
    """By id."""
    connections: dict[int, None] = field(default_factory=dict)
    """By id."""

    def include(self, earlier: Touched) -> None:
        """Include the changes before this one."""
        self.since = earlier.since
        self.contents |= earlier.contents
        self.interfaces = {**earlier.interfaces, **self.interfaces}
        self.links = {**earlier.links, **self.links}
        self.connections = {**earlier.connections, **self.connections}


@dataclass(frozen=True, slots=True)
class _Write:
    table: Table[Any]
    key: str
    before: Any


@dataclass(slots=True)
class Changes:
    """The changes of one command and their effects."""

    touched: dict[str, Touched] = field(default_factory=dict)
    """The changes in the specs of endpoints that are still desired, by their ids."""
    withdrawals: list[Withdrawal] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)
    events: list[StateEvent] = field(default_factory=list)
    volume_removals: list[VolumeRemoval] = field(default_factory=list)
    """Volumes that task sets are to remove."""
    volume_moves: list[str] = field(default_factory=list)
    """Containers whose moves have reached another phase: task sets are told to save or to restore volumes."""
    arrived: str = ""
    """Process name of the task set that is to be synchronised."""
    answered: str = ""
    """Id of an endpoint whose spec goes out with the answer to the command, so that it needs no ``Put``."""
    wanted_specs: list[tuple[str, str]] = field(default_factory=list)
    """Process names and endpoint ids: which task sets are to get which whole specs again."""
    wanted_statuses: list[tuple[str, str]] = field(default_factory=list)
    """Process names and endpoint ids: which task sets are to report which endpoints as a whole."""
    unfinished: bool = False
    """Whether work is left that a :class:`rce_master.state.commands.Continue` has to do."""
    _writes: list[_Write] = field(default_factory=list)

    def written(self) -> dict[tuple[str, str], Table[Any]]:
        """Return the records that the store has to keep: name of the table and key, to the table."""
        return {(w.table.name, w.key): w.table for w in self._writes if w.table.persistent}

    def rows(self) -> list[Row]:
        """Return the rows for the store, each key once."""
        return [make_row(table, key) for (_, key), table in self.written().items()]

    def revert(self) -> None:
        """Undo everything. Changes must be reverted in the reverse order of their making."""
        for write in reversed(self._writes):
            write.table.assign(write.key, write.before)
        self._writes.clear()

    def record(self, table: Table[Any], key: str, before: Any) -> None:
        """Note the former record before a write."""
        self._writes.append(_Write(table, key, before))


def make_row(table: Table[Any], key: str) -> Row:
    """Return a record as a row of the store; for a removed one, its removal."""
    record = table.get(key)
    return Row(table.name, key, None if record is None else table.encode(record))


class Transaction:
    """Access to the tables for one command; all its writes can be undone.

    Args:
        tables: The tables.
        now: Seconds of a monotonic clock.
        settings: Limits and grace times.
        make_token: Makes a secret for a link.
        max_work: In place of that of the settings.
    """

    def __init__(
        self,
        tables: Tables,
        now: float,
        settings: StateSettings,
        make_token: Callable[[], str],
        max_work: int | None = None,
    ) -> None:
        self.tables = tables
        self.now = now
        self.settings = settings
        self.changes = Changes()
        self._make_token = make_token
        self._work_left = settings.max_work if max_work is None else max_work

    def put(
        self,
        record: User
        | Token
        | KnownLogin
        | UserLimits
        | KeptAnswer
        | PackageKey
        | UserPackage
        | UserVolume
        | VolumeRemoval
        | VolumeMove
        | SavedState
        | Endpoint
        | Interface
        | Link
        | Connection
        | ActiveInterface
        | OpenEnd
        | TaskSet
        | RobotLive
        | ContainerLive
        | Presence
        | Lockout
        | Tombstone
        | Drain
        | Move
        | Departure,
    ) -> None:
        """Write a record into its table."""
        self._assign(self._table_of(record), record)

    def delete(self, table: Table[Any], key: str) -> None:
        """Remove a record if it exists."""
        if key in table:
            self.changes.record(table, key, table[key])
            table.assign(key, None)

    def touch(self, endpoint: str) -> None:
        """Note that an endpoint's spec changed in parts other than interfaces, links and connections."""
        self._touched(endpoint).contents = True

    def touch_interface(self, endpoint: str, tag: str) -> None:
        """Note that an endpoint got or lost an interface."""
        self._touched(endpoint).interfaces[tag] = None

    def touch_link(self, endpoint: str, link: str) -> None:
        """Note that an endpoint's end of a link changed."""
        self._touched(endpoint).links[link] = None

    def touch_connection(self, connection: Connection) -> None:
        """Note that two endpoints got or lost a connection."""
        for endpoint in (connection.a, connection.b):
            self._touched(endpoint).connections[connection.id] = None

    def _touched(self, endpoint: str) -> Touched:
        return self.changes.touched.setdefault(endpoint, Touched())

    def next_number(self, counter: str) -> int:
        """Take the next number of a counter."""
        found = self.tables.counters.get(counter)
        value = (found.value if found else 0) + 1
        self._assign(self.tables.counters, Counter(name=counter, value=value))
        return value

    def newest(self, counter: str) -> int:
        """Return the last number that was taken from a counter."""
        found = self.tables.counters.get(counter)
        return found.value if found else 0

    def raise_counter(self, counter: str, value: int) -> None:
        """Make a counter continue above a value."""
        found = self.tables.counters.get(counter)
        if value > (found.value if found else 0):
            self._assign(self.tables.counters, Counter(name=counter, value=value))

    def new_token(self) -> str:
        """Make a secret for a link."""
        return self._make_token()

    def withdraw(self, process: str, endpoint: str, reason: str, *, elsewhere: bool = False) -> None:
        """Have a task set drop an endpoint.

        Args:
            process: The task set.
            endpoint: Its id.
            reason: For its user.
            elsewhere: Whether it continues at another task set (:class:`rce.control.Drop`).
        """
        revision = self.next_number("revision")
        self.changes.withdrawals.append(Withdrawal(process, endpoint, revision, reason, elsewhere))

    def notify(self, to: str, text: str) -> None:
        """Have an ``ER`` sent to a robot or to all robots of a user."""
        self.changes.notices.append(Notice(to, text))

    def happen(self, kind: str, subject: str, text: str = "", *, user: str | None = None) -> None:
        """Note an event. Without ``user``, the subject is an endpoint id that contains it."""
        owner = subject.partition("/")[0] if user is None else user
        self.changes.events.append(StateEvent(kind, owner, subject, text))

    def spend(self, work: int) -> None:
        """Note work that may be continued by a later command."""
        self._work_left -= work

    def is_out_of_work(self) -> bool:
        """Whether to leave the rest to a later command; notes that there is a rest."""
        if self._work_left > 0:
            return False
        self.changes.unfinished = True
        return True

    def seal(self) -> Changes:
        """Give every touched endpoint its new revision and return the changes."""
        touched = self.changes.touched
        self.changes.touched = {}
        for id_, parts in touched.items():
            endpoint = self.tables.endpoints.get(id_)
            if endpoint is not None:
                parts.since = endpoint.revision
                self.put(replace(endpoint, revision=self.next_number("revision")))
                self.changes.touched[id_] = parts
        return self.changes

    def _assign(self, table: Table[R], record: R) -> None:
        key = table.key(record)
        before = table.get(key)
        if before != record:
            self.changes.record(table, key, before)
            table.assign(key, record)

    def _table_of(self, record: Any) -> Table[Any]:
        table: Table[Any] = getattr(self.tables, _TABLES[type(record)])
        return table


_TABLES: dict[type, str] = {
    User: "users",
    Token: "tokens",
    KnownLogin: "known_logins",
    UserLimits: "user_limits",
    KeptAnswer: "answers",
    PackageKey: "package_keys",
    UserPackage: "packages",
    UserVolume: "volumes",
    VolumeRemoval: "volume_removals",
    VolumeMove: "volume_moves",
    SavedState: "saved_states",
    Robot: "endpoints",
    Container: "endpoints",
    Interface: "interfaces",
    Link: "links",
    Connection: "connections",
    ActiveInterface: "active",
    OpenEnd: "open_ends",
    TaskSet: "task_sets",
    RobotLive: "live",
    ContainerLive: "live",
    Presence: "presence",
    Lockout: "lockouts",
    Tombstone: "tombstones",
    Drain: "drains",
    Move: "moves",
    Departure: "departures",
}
