"""Stores that an earlier release wrote are read as they are, and what they lack has its default."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING

from rce.model.specs import Network, RestartPolicy
from rce_master.backup import MASTER, back_up, restore
from rce_master.state.core import State
from rce_master.state.migration import conversion, converted
from rce_master.state_service import StateService
from rce_master.store import MemoryStore, SqliteStore
from rce_master.store.base import SCHEMA_VERSION
from rce_master.store.sqlite import FILE_NAME

if TYPE_CHECKING:
    from pathlib import Path

# As the first release wrote them.
ROWS = {
    "users": {"anna": b'{"name":"anna","role":"user","password":"x","created":0.0}'},
    "tokens": {"d": b'{"digest":"d","user":"anna","label":"","created":0.0,"expires":9000000000.0}'},
    "endpoints": {
        "anna/rob": b'{"type":"Robot","id":"anna/rob","revision":7,"task_set":"r1","interfaces":{"out":'
        b'{"tag":"out","type":"SubscriberConverter","cls":"std_msgs/String"}},"size":66}',
        "anna/c": b'{"type":"Container","id":"anna/c","revision":8,"task_set":"c1","interfaces":{"in":'
        b'{"tag":"in","type":"PublisherInterface","cls":"std_msgs/String","addr":"/in"}},"size":207,"resources":'
        b'{"group":"g","group_ip":"10.0.0.2","size":2,"cpu":0.5,"memory":1000,"bandwidth":5},"nodes":{"n":{"tag":"n","pkg":'
        b'"Test","exe":"run.py"}},"parameters":{"p":1.5},"address":{}}',
    },
    "links": {
        "link1": b'{"id":"link1","a":"anna/c","b":"anna/rob","token":"secret","connections":{"1":{"id":1,'
        b'"interface_a":"in","interface_b":"out"}}}'
    },
    "task_sets": {
        "r1": b'{"process":"r1","kind":"robot","machine":{"name":"m"},"url":"ws://r1/","address":{"machine":"m",'
        b'"host":"h","port":1}}',
        "c1": b'{"process":"c1","kind":"container","machine":{"name":"m"},"url":"","address":{}}',
    },
    "counters": {
        "revision": b'{"name":"revision","value":8}',
        "link": b'{"name":"link","value":1}',
        "connection": b'{"name":"connection","value":1}',
    },
}


def test_what_the_first_release_wrote_is_read() -> None:
    state = State.load(ROWS, 0.0)
    state.validate()
    spec = state.spec("anna/c")
    (node,) = spec.nodes
    assert (node.restart, node.after, node.heartbeat) == (RestartPolicy.NEVER, (), "")
    assert (spec.resources.network, spec.resources.image, spec.resources.cpu) == (Network.NONE, "", 0.5)
    assert [one.id for one in spec.connections] == [1]
    container = state.tables.container("anna/c")
    assert container is not None
    assert (container.made, container.number, container.born) == (None, 0, 0)


def test_interfaces_and_connections_get_rows_of_their_own() -> None:
    tables = converted(ROWS)
    assert set(tables["interfaces"]) == {"anna/rob/out", "anna/c/in"}
    assert set(tables["connections"]) == {"1"}
    assert b"interfaces" not in tables["endpoints"]["anna/c"]
    assert b"connections" not in tables["links"]["link1"]
    assert conversion(tables) == []
    assert State.load(tables, 0.0).spec("anna/c") == State.load(ROWS, 0.0).spec("anna/c")


def test_a_conversion_that_was_interrupted_is_done_again() -> None:
    tables = {name: dict(rows) for name, rows in ROWS.items()}
    half = conversion(ROWS)[:2]
    for row in half:
        assert row.body is not None
        tables.setdefault(row.table, {})[row.key] = row.body
    state = State.load(tables, 0.0)
    state.validate()
    assert [one.tag for one in state.spec("anna/c").interfaces] == ["in"]
    assert [one.tag for one in state.spec("anna/rob").interfaces] == ["out"]


async def test_earlier_store_is_converted_when_opened() -> None:
    """The store of an earlier release is converted when it is opened."""
    store = MemoryStore()
    store.tables = {name: dict(rows) for name, rows in ROWS.items()}
    service = await StateService.open(store)
    service.state.validate()
    assert set(store.tables["interfaces"]) == {"anna/rob/out", "anna/c/in"}
    again = await StateService.open(store)
    assert again.spec("anna/c").interfaces == service.spec("anna/c").interfaces


def write_first_version(folder: Path) -> None:
    """Make a store as the release before made it."""
    folder.mkdir()
    with closing(sqlite3.connect(folder / FILE_NAME)) as database:
        database.execute(
            "CREATE TABLE record (kind TEXT NOT NULL, key TEXT NOT NULL, body BLOB NOT NULL,"
            " PRIMARY KEY (kind, key)) WITHOUT ROWID"
        )
        rows = [(table, key, body) for table, found in ROWS.items() for key, body in found.items()]
        database.executemany("INSERT INTO record VALUES (?, ?, ?)", rows)
        database.execute("PRAGMA user_version = 1")
        database.commit()


async def test_a_backup_of_the_first_version_is_restored_and_converted(tmp_path: Path) -> None:
    write_first_version(tmp_path / "old")
    back_up({MASTER: tmp_path / "old"}, tmp_path / "copy.tar")
    restore(tmp_path / "copy.tar", {MASTER: tmp_path / "new"})
    specs = []
    for _ in range(2):
        store = await SqliteStore.open(tmp_path / "new")
        try:
            service = await StateService.open(store)
            service.state.validate()
            specs.append(service.spec("anna/c"))
        finally:
            await store.close()
    assert specs[0] == specs[1]
    assert [one.tag for one in specs[0].interfaces] == ["in"]
    with closing(sqlite3.connect(tmp_path / "new" / FILE_NAME)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        kept = database.execute("SELECT body FROM record WHERE kind = 'links'").fetchall()
    assert b"connections" not in kept[0][0]
