"""The journal: an SQLite file with all events, and the newest record of everything they happened to.

Events and records of one batch are written in one transaction, in the write-ahead log, with
``synchronous = FULL``: when :meth:`Journal.append` returns, they survive the end of the process and of the
machine. Records are at each moment the snapshot after the last event, so that loading takes no longer after a
million events.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from rce_fleet.exceptions import JournalError, JournalInUseError
from rce_fleet.tasks.records import RECORD_TYPES, FleetEvent, GoalEntry, Record, Zone, key_of
from rce_fleet.tasks.task import Task

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence
    from pathlib import Path

SCHEMA = 3
"""Version of the tables. Version 1 had no minutes, and other fields instead of robots' modes; 2 had other
words for two kinds of zones."""
_FROM_1 = """
UPDATE records SET record = json_set(CAST(record AS TEXT), '$.mode', CASE
    WHEN json_extract(CAST(record AS TEXT), '$.is_out') THEN 'out_of_service'
    WHEN json_extract(CAST(record AS TEXT), '$.is_paused') THEN 'paused'
    ELSE 'automatic' END)
WHERE kind = 'robot';
"""
_FROM_2 = """
UPDATE records SET record = json_set(CAST(record AS TEXT), '$.kind',
    CASE json_extract(CAST(record AS TEXT), '$.kind') WHEN 'room' THEN 'limited' ELSE 'one_way' END)
WHERE kind = 'zone' AND json_extract(CAST(record AS TEXT), '$.kind') IN ('room', 'one-way');
"""
LOCK_WAIT_S = 15.0
"""How long to wait for a manager that is ending to leave the file."""
_TABLES = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS events (
    number INTEGER PRIMARY KEY, time REAL NOT NULL, kind TEXT NOT NULL, id TEXT NOT NULL,
    name TEXT NOT NULL, user TEXT NOT NULL, text TEXT NOT NULL, state TEXT NOT NULL, robot TEXT NOT NULL,
    revision INTEGER NOT NULL
);
CREATE INDEX IF NOT EXISTS events_by_time ON events (time);
CREATE INDEX IF NOT EXISTS events_by_id ON events (id, number);
CREATE TABLE IF NOT EXISTS records (
    kind TEXT NOT NULL, id TEXT NOT NULL, record BLOB NOT NULL, PRIMARY KEY (kind, id)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS minutes (began REAL PRIMARY KEY, busy REAL NOT NULL, total REAL NOT NULL)
WITHOUT ROWID;
"""
_QUERY = """
SELECT * FROM events
WHERE number > :after AND time >= :since AND time < :until {also} ORDER BY number LIMIT :limit
"""
_OF_ONE = "AND id = :id"
_OF_KINDS = "AND kind IN (SELECT value FROM json_each(:kinds))"
_OF_ROBOT = "AND (robot = :robot OR (kind IN ('robot', 'goal') AND id = :robot))"
"""A condition of its own: with ``:id = '' OR id = :id`` SQLite would look at all events, not at the index."""
_LAST_TASK = """
SELECT max(CAST(substr(id, 2) AS INTEGER)) FROM (
    SELECT id FROM events WHERE kind = 'task' UNION ALL SELECT id FROM records WHERE kind = 'task'
)
"""
_COLUMNS = ("number", "time", "kind", "id", "name", "user", "text", "state", "robot", "revision")

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class EventQuery:
    """Which events to return.

    Attributes:
        after: Only events with larger numbers.
        since: Only events from this time on, seconds since 1970; None: all.
        until: Only events before this time; None: all.
        id: Only events of this task or robot; empty: all.
        limit: At most so many, the oldest first.
        kinds: Only events of these kinds; empty: all.
        robot: Only events in which this robot took part; empty: all.
    """

    after: int = 0
    since: float | None = None
    until: float | None = None
    id: str = ""
    limit: int = 1000
    kinds: tuple[str, ...] = ()
    robot: str = ""


class Journal:
    """The journal of one manager. Calls block; one thread at a time may call.

    Args:
        path: The file; its folder must exist.

    Raises:
        JournalInUseError: Another manager uses it.
        JournalError: It cannot be opened, or is of a newer release.

    Attributes:
        id: Which journal it is. A new file has another one: its events are numbered from 1 again.
        last_task: The largest number of a task that was written, also if the task was forgotten since.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._db = self._wait_for(self._open)
        self.id: str = self._run(_read_id, "opened")
        self.last_task: int = self._run(_read_last_task, "opened")

    def append(self, events: Sequence[FleetEvent], forgotten: Collection[tuple[str, str]] = ()) -> None:
        """Write events and their records; when this returns they are on the disk.

        Args:
            events: In order; each number is one larger than the one before.
            forgotten: Kind and id of records to remove.

        Raises:
            JournalError: They could not be written; none of them was.
        """
        newest = {(event.kind, event.id): event.record for event in events}
        rows = [event_row(event) for event in events]
        write_records = _writer_of(newest.values(), forgotten)
        numbers = (record.number for record in newest.values() if isinstance(record, Task))
        last_task = max(numbers, default=0)

        def write(db: sqlite3.Connection) -> None:
            with db:
                db.executemany("INSERT INTO events VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
                write_records(db)
                if last_task > self.last_task:
                    db.execute("INSERT OR REPLACE INTO meta VALUES ('last task', ?)", (last_task,))

        self._run(write, "written")
        self.last_task = max(self.last_task, last_task)

    def put(self, records: Iterable[Record]) -> None:
        """Replace records about which there is nothing to tell; there is no event.

        Raises:
            JournalError: They could not be written.
        """
        write_records = _writer_of(records)

        def write(db: sqlite3.Connection) -> None:
            with db:
                write_records(db)

        self._run(write, "written")

    def load(self) -> tuple[list[Record], int]:
        """Return all records, and the number of the last event.

        Raises:
            JournalError: The file cannot be read.
        """
        rows = self._run(lambda db: db.execute("SELECT kind, id, record FROM records").fetchall(), "read")
        last = self._run(lambda db: db.execute("SELECT max(number) FROM events").fetchone()[0], "read")
        records: list[Record] = []
        for kind, key, data in rows:
            try:
                records.append(msgspec.json.decode(data, type=RECORD_TYPES[kind]))
            except (KeyError, msgspec.MsgspecError) as error:
                raise JournalError(
                    f"{self._path}: the record of {kind} {key} cannot be read: {error}; restore the file"
                    " from a backup, or move it away to begin without the tasks in it"
                ) from error
        return records, int(last or 0)

    def events(self, query: EventQuery) -> list[dict[str, Any]]:
        """Return events, the oldest first.

        Raises:
            JournalError: The file cannot be read.
        """
        conditions = ((query.id, _OF_ONE), (query.kinds, _OF_KINDS), (query.robot, _OF_ROBOT))
        text = _QUERY.format(also=" ".join(condition for wanted, condition in conditions if wanted))
        values = {
            "after": query.after,
            "since": -inf if query.since is None else query.since,
            "until": inf if query.until is None else query.until,
            "id": query.id,
            "limit": query.limit,
            "kinds": json.dumps(query.kinds),
            "robot": query.robot,
        }
        rows = self._run(lambda db: db.execute(text, values).fetchall(), "read")
        return [dict(zip(_COLUMNS, row, strict=True)) for row in rows]

    def forget_events(self, before: int) -> None:
        """Remove the events with numbers below ``before``.

        Raises:
            JournalError: They could not be removed.
        """

        def remove(db: sqlite3.Connection) -> None:
            with db:
                db.execute("DELETE FROM events WHERE number < ?", (before,))

        self._run(remove, "written")

    def put_minute(self, began: float, busy: float, total: float, forget_before: float) -> None:
        """Keep the work of one minute, and forget old ones.

        Args:
            began: When it began, seconds since 1970.
            busy: Seconds of robots with a task, summed up.
            total: Seconds of robots in service, summed up.
            forget_before: Minutes that began earlier are removed.

        Raises:
            JournalError: It could not be written.
        """

        def write(db: sqlite3.Connection) -> None:
            with db:
                db.execute("INSERT OR REPLACE INTO minutes VALUES (?, ?, ?)", (began, busy, total))
                db.execute("DELETE FROM minutes WHERE began < ?", (forget_before,))

        self._run(write, "written")

    def minutes(self) -> list[tuple[float, float, float]]:
        """Return when each kept minute began, with the seconds of robots with a task, and in service.

        Raises:
            JournalError: The file cannot be read.
        """
        query = "SELECT began, busy, total FROM minutes ORDER BY began"
        return self._run(lambda db: db.execute(query).fetchall(), "read")

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    # Inner

    def _open(self) -> sqlite3.Connection:
        db = sqlite3.connect(self._path, timeout=0.0, check_same_thread=False, isolation_level=None)
        try:
            db.execute("PRAGMA locking_mode = EXCLUSIVE")
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.execute("BEGIN EXCLUSIVE")
            db.execute("COMMIT")
            self._check_schema(db)
        except BaseException:
            db.close()
            raise
        db.isolation_level = "DEFERRED"
        return db

    def _check_schema(self, db: sqlite3.Connection) -> None:
        (found,) = db.execute("PRAGMA user_version").fetchone()
        if found > SCHEMA:
            raise JournalError(
                f"{self._path} is a journal of a newer release (schema {found}; this release knows {SCHEMA}):"
                " start that release, or give another file"
            )
        if found < SCHEMA:
            convert = {0: "", 1: _FROM_1 + _FROM_2}.get(found, _FROM_2)
            db.executescript(f"BEGIN; {_TABLES} {convert} PRAGMA user_version = {SCHEMA}; COMMIT;")

    def _wait_for(self, open_file: Callable[[], sqlite3.Connection]) -> sqlite3.Connection:
        """Open the file; wait for a manager that is ending."""
        until = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                return open_file()
            except sqlite3.Error as error:
                if "locked" not in str(error):
                    raise self._error(error, "opened") from error
                if time.monotonic() > until:
                    raise JournalInUseError(
                        f"{self._path} is used by another fleet manager; end it, or give another file"
                    ) from error
            time.sleep(0.1)

    def _run(self, work: Callable[[sqlite3.Connection], T], what: str) -> T:
        try:
            return work(self._db)
        except sqlite3.Error as error:
            raise self._error(error, what) from error

    def _error(self, error: sqlite3.Error, what: str) -> JournalError:
        text = str(error)
        if "full" in text:
            text = f"the disk is full ({text}); free some space"
        elif "malformed" in text or "not a database" in text:
            text = f"it is damaged ({text}); restore it, or move it away to begin without its tasks"
        return JournalError(f"the journal {self._path} cannot be {what}: {text}")


def _writer_of(
    records: Iterable[Record], forgotten: Collection[tuple[str, str]] = ()
) -> Callable[[sqlite3.Connection], None]:
    """Return what replaces records, and removes those that are forgotten or say nothing any more."""
    kept, gone = [], list(forgotten)
    for record in records:
        if _says_nothing(record):
            gone.append(key_of(record))
        else:
            kept.append((*key_of(record), msgspec.json.encode(record)))

    def write(db: sqlite3.Connection) -> None:
        db.executemany("INSERT OR REPLACE INTO records VALUES (?, ?, ?)", kept)
        db.executemany("DELETE FROM records WHERE kind = ? AND id = ?", gone)

    return write


def _says_nothing(record: Record) -> bool:
    """Return whether a manager without this record would do the same."""
    if isinstance(record, Zone):
        return record.is_removed and not record.unsent
    if isinstance(record, GoalEntry):
        return record.cell is None and not record.unsent
    return False


def _read_id(db: sqlite3.Connection) -> str:
    """Return which journal it is; a new one gets a number drawn at random."""
    query = "SELECT value FROM meta WHERE name = 'journal'"
    found = db.execute(query).fetchone()
    if found is None:
        with db:
            db.execute("INSERT INTO meta VALUES ('journal', ?)", (secrets.randbits(48),))
        found = db.execute(query).fetchone()
    return f"{found[0]:012x}"


def _read_last_task(db: sqlite3.Connection) -> int:
    """Return the largest number of a task; earlier releases wrote it in events and records only."""
    found = db.execute("SELECT value FROM meta WHERE name = 'last task'").fetchone()
    if found is None:
        found = db.execute(_LAST_TASK).fetchone()
    return int(found[0] or 0)


def event_row(event: FleetEvent) -> tuple[Any, ...]:
    """Return an event as the journal's table has it."""
    task = event.record if isinstance(event.record, Task) else None
    return (
        *(event.number, event.time, event.kind, event.id, event.name, event.user, event.text),
        *((task.state.value, task.robot, task.revision) if task is not None else ("", "", 0)),
    )


def event_fields(events: Iterable[FleetEvent]) -> list[dict[str, Any]]:
    """Return events as :meth:`Journal.events` does."""
    return [dict(zip(_COLUMNS, event_row(event), strict=True)) for event in events]
