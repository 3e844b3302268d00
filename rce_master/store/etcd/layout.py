"""The keys below a prefix of etcd, and what they hold.

::

schema                  version of what the rows hold
engine                  which engine's they are
leadership/leader       name and term of the leading master; removed when its lease ends
leadership/term         the newest term, and a mark of the store that began it
leadership/last         TERM:NUMBER of the last save
leadership/drained/NAME a master that is not to lead
masters/NAME            where other masters reach one; removed a day after it was last seen
tables/TABLE/KEY        a row
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_master.exceptions import StoreError
from rce_master.store.base import SCHEMA_VERSION, other_version
from rce_master.store.etcd.wire import Condition, Put, Record, Subject

if TYPE_CHECKING:
    from rce_master.store.etcd.client import EtcdClient

MAX_OPERATIONS = 4096
"""Operations of one level of a transaction that etcd must allow; its default is 128."""


@dataclass(frozen=True, slots=True)
class Leader:
    """The leading master, as the store knows it."""

    name: str
    term: int
    url: str = ""
    """Where other masters reach its HTTP server; empty: it does not say."""


@dataclass(frozen=True, slots=True)
class OtherMaster:
    """A master of the same engine, which may be down."""

    name: str
    url: str
    """Where other masters reach its HTTP server."""


@dataclass(frozen=True, slots=True)
class LeadershipView:
    """What etcd knows about the leadership, at one moment."""

    leader: Leader | None
    """None: no master leads."""
    drained: frozenset[str]
    """Names of masters that are not to lead."""
    last: int
    """The revision of the last save; 0: none was made."""


class Keys:
    """The keys below a prefix."""

    def __init__(self, prefix: str) -> None:
        self.root = prefix.rstrip("/") + "/"
        self.schema = self.root + "schema"
        self.engine = self.root + "engine"
        self.leadership = self.root + "leadership/"
        self.leader = self.leadership + "leader"
        self.term = self.leadership + "term"
        self.last = self.leadership + "last"
        self.drained = self.leadership + "drained/"
        self.masters = self.root + "masters/"
        self.tables = self.root + "tables/"

    def row(self, table: str, key: str) -> str:
        """Return the key of a row."""
        return f"{self.tables}{table}/{key}"

    def read_row(self, key: str) -> tuple[str, str]:
        """Return the table and the key of a row."""
        table, _, rest = key.removeprefix(self.tables).partition("/")
        return table, rest


async def prepare(client: EtcdClient, prefix: str) -> None:
    """Check that a prefix of an etcd can hold the state; mark an empty one as an engine's.

    Raises:
        StoreError: etcd cannot be used as it is, the prefix has keys of another program, or a newer release
            wrote it. Nothing was overwritten.
    """
    await client.check_members()
    keys = Keys(prefix)
    schema = await client.get(keys.schema)
    if schema is None:
        there = (await client.range(keys.root, limit=1, keys_only=True)).records
        schema = await client.get(keys.schema) if there else None  # another master may have begun just now
        if there and schema is None:
            raise StoreError(
                f"etcd has keys of another program below {keys.root}, such as {there[0].key!r};"
                " choose another prefix: etcd://HOST:2379/PREFIX"
            )
    if schema is None:
        mark = Put(keys.schema, str(SCHEMA_VERSION).encode())
        absent = Condition(keys.schema, Subject.CREATED, 0)
        found = (await client.transact([absent], [mark], [keys.schema])).found
        schema = found[0] if found else None
    if schema is not None:
        _check_version(keys, schema)
    # Without a condition these reads are never done, but etcd counts them.
    await client.transact([], [], [keys.schema] * MAX_OPERATIONS)


async def check_state(client: EtcdClient, prefix: str) -> None:
    """Check that there is a state below a prefix that this program can read; nothing is written.

    Raises:
        StoreError: There is none, or etcd cannot be used.
    """
    await client.check_members()
    keys = Keys(prefix)
    schema = await client.get(keys.schema)
    if schema is None:
        raise StoreError(f"etcd has no state of an engine below {keys.root}")
    _check_version(keys, schema)


def _check_version(keys: Keys, schema: Record) -> None:
    if schema.value != str(SCHEMA_VERSION).encode():
        version = schema.value.decode(errors="replace")
        raise StoreError(other_version(f"the store in etcd below {keys.root}", version))


def write_number(term: int, number: int) -> bytes:
    """Return what the key of the last save holds."""
    return f"{term}:{number}".encode()


def read_leader(record: Record) -> Leader:
    """Read the leader key.

    Raises:
        StoreError: It was overwritten by another program.
    """
    try:
        value = json.loads(record.value)
        return Leader(str(value["name"]), int(value["term"]), str(value.get("url", "")))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"the key {record.key} of etcd was overwritten") from error


def write_master(url: str) -> bytes:
    """Return what the key of a master holds."""
    return json.dumps({"url": url}).encode()


def read_master(keys: Keys, record: Record) -> OtherMaster:
    """Read the key of a master.

    Raises:
        StoreError: It was overwritten by another program.
    """
    try:
        return OtherMaster(record.key.removeprefix(keys.masters), str(json.loads(record.value)["url"]))
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"the key {record.key} of etcd was overwritten") from error


def read_term(record: Record) -> int:
    """Read the newest term.

    Raises:
        StoreError: Its key was overwritten by another program.
    """
    try:
        return int(json.loads(record.value)["term"])
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"the key {record.key} of etcd was overwritten") from error


def read_mark(record: Record) -> str:
    """Read the mark of the store that began the newest term.

    Raises:
        StoreError: Its key was overwritten by another program.
    """
    try:
        return str(json.loads(record.value).get("mark", ""))
    except (ValueError, AttributeError) as error:
        raise StoreError(f"the key {record.key} of etcd was overwritten") from error
