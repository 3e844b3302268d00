from __future__ import annotations

import contextlib
import sqlite3
import stat
from typing import TYPE_CHECKING

import pytest
from support.store_laws import check_round_trip, check_snapshot, check_terms

from rce_master.exceptions import StoreBusyError, StoreError
from rce_master.store import MemoryStore, Row, SqliteStore
from rce_master.store.sqlite import TRIAL_BYTES

if TYPE_CHECKING:
    from pathlib import Path


async def test_who_has_an_older_term_writes_nothing(tmp_path: Path) -> None:
    await check_terms(MemoryStore())
    store = await SqliteStore.open(tmp_path / "state")
    last = await check_terms(store)
    await store.close()
    store = await SqliteStore.open(tmp_path / "state")
    found = await store.begin_term()
    await store.close()
    assert found == last + 1


async def test_memory_store_keeps_rows() -> None:
    await check_round_trip(MemoryStore())
    await check_snapshot(MemoryStore())


async def test_sqlite_store_keeps_all_kinds_of_rows(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path / "state")
    await check_snapshot(store)
    await store.close()


async def test_sqlite_store_keeps_rows_over_a_restart(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path / "state")
    await check_round_trip(store)
    await store.close()
    store = await SqliteStore.open(tmp_path / "state")
    assert await store.load() == {"users": {"b": b"4"}, "links": {"a": b"3"}}
    await store.close()


async def test_what_was_saved_is_there_without_a_close(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path)
    await store.save([Row("users", "a", b"1")])
    reader = sqlite3.connect(tmp_path / "rce.sqlite")
    assert reader.execute("SELECT kind, key, body FROM record").fetchall() == [("users", "a", b"1")]
    reader.close()
    await store.close()


async def test_a_save_without_rows_writes_to_the_file(tmp_path: Path) -> None:
    """Only so it proves that there is room."""
    store = await SqliteStore.open(tmp_path)
    await store.save([Row("users", "a", b"1")])
    log = tmp_path / "rce.sqlite-wal"
    before = log.stat().st_size
    await store.save([])
    assert log.stat().st_size > before + TRIAL_BYTES
    with contextlib.closing(sqlite3.connect(tmp_path / "rce.sqlite")) as reader:
        pages = reader.execute("PRAGMA page_count").fetchall()
        await store.save([])
        assert reader.execute("PRAGMA page_count").fetchall() == pages, "it leaves nothing behind"
    assert await store.load() == {"users": {"a": b"1"}}
    await store.close()


async def test_only_the_owner_can_read_it(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path / "state")
    await store.close()
    assert stat.S_IMODE((tmp_path / "state").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "state" / "rce.sqlite").stat().st_mode) == 0o600


async def test_two_masters_do_not_share_a_folder(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path)
    with pytest.raises(StoreBusyError, match="a master is running"):
        await SqliteStore.open(tmp_path)
    await store.close()
    await (await SqliteStore.open(tmp_path)).close()


async def test_a_store_of_a_newer_program_is_refused(tmp_path: Path) -> None:
    database = sqlite3.connect(tmp_path / "rce.sqlite")
    database.execute("PRAGMA user_version = 99")
    database.commit()
    database.close()
    with pytest.raises(StoreError, match=r"has version 99, .*install the release .*restore a backup"):
        await SqliteStore.open(tmp_path)


async def test_a_file_that_is_no_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rce.sqlite").write_bytes(b"nonsense" * 1000)
    with pytest.raises(StoreError, match="cannot open the store"):
        await SqliteStore.open(tmp_path)


async def test_a_failed_save_writes_nothing(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path)
    bad = Row("users", "b", object())  # type: ignore[arg-type]  # no store can keep it
    with pytest.raises(StoreError):
        await store.save([Row("users", "a", b"1"), bad])
    await store.save([Row("users", "c", b"3")])
    assert await store.load() == {"users": {"c": b"3"}}
    await store.close()


async def test_nothing_is_saved_into_a_file_that_was_taken_away(tmp_path: Path) -> None:
    store = await SqliteStore.open(tmp_path)
    await store.save([Row("users", "a", b"1")])
    (tmp_path / "rce.sqlite").rename(tmp_path / "backup")
    with pytest.raises(StoreError, match="removed or replaced"):
        await store.save([Row("users", "b", b"2")])
    (tmp_path / "rce.sqlite").write_bytes(b"")
    with pytest.raises(StoreError, match="removed or replaced"):
        await store.save([Row("users", "b", b"2")])
    (tmp_path / "backup").replace(tmp_path / "rce.sqlite")
    await store.save([Row("users", "b", b"2")])
    assert await store.load() == {"users": {"a": b"1", "b": b"2"}}
    await store.close()
