"""The store in an SQLite file."""

from __future__ import annotations

import os
import sqlite3
from typing import TYPE_CHECKING

import aiosqlite

from rce.config import STORE_FILE
from rce_master.exceptions import StaleTermError, StoreError
from rce_master.store.base import SCHEMA_VERSION, other_version
from rce_master.store.lock import FolderLock

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rce_master.store.base import Row, Snapshot

_CONVERTIBLE = 1
FILE_NAME = STORE_FILE

_SCHEMA = """
CREATE TABLE record (
    kind TEXT NOT NULL, key TEXT NOT NULL, body BLOB NOT NULL, PRIMARY KEY (kind, key)
) WITHOUT ROWID
"""
_LEASE = """
CREATE TABLE IF NOT EXISTS lease (one INTEGER PRIMARY KEY CHECK (one = 1), term INTEGER NOT NULL)
"""
_NEXT_TERM = """
INSERT INTO lease VALUES (1, 1 + :above) ON CONFLICT DO UPDATE SET term = max(term, :above) + 1
"""
_PUT = "INSERT INTO record (kind, key, body) VALUES (?, ?, ?) ON CONFLICT DO UPDATE SET body = excluded.body"
_DELETE = "DELETE FROM record WHERE kind = ? AND key = ?"
_TRIAL = "CREATE TABLE IF NOT EXISTS trial (body BLOB NOT NULL)"
TRIAL_BYTES = 1 << 18
"""A disk that has room for less is still full: small rows fit into what the last write left over."""


class SqliteStore:
    """A store in ``FOLDER/rce.sqlite``; the folder is locked while it is open.

    Written with a write-ahead log and a sync at every commit, so what was saved survives a power cut.
    """

    def __init__(self, database: aiosqlite.Connection, lock: FolderLock, path: Path) -> None:
        self._database = database
        self._lock = lock
        self._path = path
        self._inode = path.stat().st_ino

    @classmethod
    async def open(cls, folder: Path) -> SqliteStore:
        """Open the store of a folder; made if it is not there.

        Raises:
            StoreBusyError: Another process has it open.
            StoreError: It cannot be opened, or a newer version of this program wrote it.
        """
        lock = FolderLock(folder)
        try:
            path = folder / FILE_NAME
            return cls(await _connect(path), lock, path)
        except BaseException:
            lock.close()
            raise

    async def load(self) -> Snapshot:
        """Read everything.

        Raises:
            StoreError: It cannot be read.
        """
        snapshot: dict[str, dict[str, bytes]] = {}
        try:
            async with self._database.execute("SELECT kind, key, body FROM record") as cursor:
                async for kind, key, body in cursor:
                    snapshot.setdefault(kind, {})[key] = body
        except sqlite3.Error as error:
            raise StoreError(f"cannot read the store: {error}") from error
        return snapshot

    async def begin_term(self, *, above: int = 0) -> int:
        """Begin a new term, greater than another one too.

        Raises:
            StoreError: None was begun.
        """
        self._check_that_it_is_there()
        try:
            await self._database.execute(_NEXT_TERM, {"above": above})
            await self._database.commit()
            return await self._newest_term()
        except sqlite3.Error as error:
            await self._roll_back()
            raise StoreError(f"cannot write the store: {error}") from error

    async def _newest_term(self) -> int:
        async with self._database.execute("SELECT term FROM lease") as cursor:
            row = await cursor.fetchone()
        return int(row[0]) if row else 0

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        """Write rows in one transaction; without rows, try whether the file can be written.

        Raises:
            StaleTermError: A newer term was begun; nothing was written.
            StoreError: Nothing was written.
        """
        self._check_that_it_is_there()
        puts = [(row.table, row.key, row.body) for row in rows if row.body is not None]
        deletes = [(row.table, row.key) for row in rows if row.body is None]
        try:
            await self._database.execute("BEGIN IMMEDIATE")
            newest = await self._newest_term()
            if term < newest:
                await self._roll_back()
                raise StaleTermError(term, newest)
            if not rows:
                await self._try_to_write()
            await self._database.executemany(_DELETE, deletes)
            await self._database.executemany(_PUT, puts)
            await self._database.commit()
        except sqlite3.Error as error:
            await self._roll_back()
            raise StoreError(f"cannot write the store: {error}") from error

    async def _try_to_write(self) -> None:
        await self._database.execute(_TRIAL)
        await self._database.execute("INSERT INTO trial VALUES (zeroblob(?))", (TRIAL_BYTES,))
        await self._database.commit()  # pages that are freed in the same transaction are not written
        await self._database.execute("DELETE FROM trial")

    async def check(self) -> None:
        """Check that the file is there and can be read.

        Raises:
            StoreError: It is not, or cannot.
        """
        self._check_that_it_is_there()
        try:
            async with self._database.execute("SELECT 1 FROM record LIMIT 1") as cursor:
                await cursor.fetchone()
        except sqlite3.Error as error:
            raise StoreError(f"cannot read the store: {error}") from error

    async def close(self) -> None:
        """Close the file and unlock the folder."""
        await self._database.close()
        self._lock.close()

    def _check_that_it_is_there(self) -> None:
        """Refuse to write to a file that was taken away: SQLite would, and all would be lost at the end."""
        try:
            there = self._path.stat().st_ino == self._inode
        except OSError:
            there = False
        if not there:
            raise StoreError(f"the store {self._path} was removed or replaced while it is in use")

    async def _roll_back(self) -> None:
        try:
            await self._database.rollback()
        except sqlite3.Error as error:
            raise StoreError(f"cannot write the store, nor take back what was begun: {error}") from error


async def _connect(path: Path) -> aiosqlite.Connection:
    try:
        # Made first, so that it never exists readable by others: it holds password hashes.
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
        database = await aiosqlite.connect(path)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"cannot open the store {path}: {error}") from error
    try:
        await _prepare(database, path)
    except sqlite3.Error as error:
        await database.close()
        raise StoreError(f"cannot open the store {path}: {error}") from error
    except BaseException:
        await database.close()
        raise
    return database


async def _prepare(database: aiosqlite.Connection, path: Path) -> None:
    await database.execute("PRAGMA journal_mode = WAL")
    await database.execute("PRAGMA synchronous = FULL")
    async with database.execute("PRAGMA user_version") as cursor:
        row = await cursor.fetchone()
    version = row[0] if row else 0
    if version == 0:
        await database.execute(_SCHEMA)
        await database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        await database.commit()
    elif version == _CONVERTIBLE:
        # Set before anything is converted: the release that wrote it must not open what is half converted.
        await database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        await database.commit()
    elif version != SCHEMA_VERSION:
        raise StoreError(other_version(f"the store {path}", version))
    await database.execute(_LEASE)
    await database.commit()
