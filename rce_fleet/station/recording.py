"""Records what the fleet did, compactly and within a bound, so that the page can replay the last hours.

A record is written for each second in which something changed: poses and states of robots that changed, and
blocked cells if they did. Every half minute a record is whole. Records are JSON, compressed, in SQLite: in a
file, which outlives the station, or in memory. The oldest ones are removed to stay within the bounds.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sqlite3
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.station.private_files import fleet_file, make_private

if TYPE_CHECKING:
    from rce_fleet.station.view import FleetView

_log = logging.getLogger(__name__)

RECORD_EVERY_S = 1.0
WHOLE_EVERY_S = 30.0
MAX_BYTES = 256 << 20
"""Bound of all records, bytes."""
IN_MEMORY_BYTES = 32 << 20
"""Bound of records that are in memory only, bytes."""
RECORDS_LAST_S = 86400.0
"""Records in a file that is not named by the user are removed when they are older, seconds."""
FIGURES_LAST_S = 86400.0
"""Figures that are older are removed, seconds."""
IN_USE_S = 2.0
"""How long to wait for a station that is ending to leave the file."""
MOST_FRAMES = 120
"""Most records in one answer."""
_REMOVE_OUTSIDE = "DELETE FROM records WHERE time < ? OR time >= ? RETURNING LENGTH(data)"
_REMOVE_OLDEST = (
    "DELETE FROM records WHERE time IN (SELECT time FROM records ORDER BY time LIMIT 50)"
    " RETURNING LENGTH(data)"
)

Frame = dict[str, Any]


class Records:
    """The records of a fleet, oldest first.

    Args:
        file: Where they are kept; None: in memory.
        limit: Most bytes of all records; None: :data:`MAX_BYTES`, or :data:`IN_MEMORY_BYTES` in memory.
        last_s: Records that are older are removed, seconds.

    Raises:
        sqlite3.Error: The file cannot be used, or another station uses it.
    """

    def __init__(self, file: Path | None = None, limit: int | None = None, last_s: float = inf) -> None:
        self._limit = limit or (IN_MEMORY_BYTES if file is None else MAX_BYTES)
        self._last_s = last_s
        self._lock = threading.Lock()
        place = ":memory:" if file is None else str(file)
        self._database = sqlite3.connect(place, timeout=IN_USE_S, check_same_thread=False)
        try:
            self._prepare(is_file=file is not None)
        except sqlite3.Error:
            self._database.close()
            raise

    def _prepare(self, *, is_file: bool) -> None:
        """Make what is missing in the database."""
        if is_file:
            # Records of two stations in one file would be changes of each other.
            self._database.execute("PRAGMA locking_mode=EXCLUSIVE")
            self._database.execute("PRAGMA journal_mode=WAL")
            self._database.execute("PRAGMA synchronous=NORMAL")
        self._database.execute(
            "CREATE TABLE IF NOT EXISTS records (time REAL PRIMARY KEY, whole INTEGER, data BLOB)"
        )
        self._database.execute("CREATE TABLE IF NOT EXISTS figures (time REAL PRIMARY KEY, data TEXT)")
        ((self._bytes,),) = self._database.execute("SELECT TOTAL(LENGTH(data)) FROM records")

    def add(self, now: float, frame: Frame, *, whole: bool) -> None:
        """Write a record, and remove the oldest ones that do not fit.

        A whole one removes those that are too old, and those of later times: the clock was set back, and a
        replay would mix both.

        Args:
            now: Seconds since 1970.
            frame: What changed.
            whole: Whether it is the complete state.

        Raises:
            sqlite3.Error: It cannot be written.
        """
        data = zlib.compress(json.dumps(frame, separators=(",", ":")).encode(), 6)
        with self._lock:
            with self._database:
                kept = self._bytes + len(data)
                if whole:
                    kept -= self._run_removal(_REMOVE_OUTSIDE, now - self._last_s, now)
                self._database.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?)", (now, whole, data))
                while kept > self._limit:
                    kept -= self._run_removal(_REMOVE_OLDEST)
            self._bytes = kept

    def _run_removal(self, statement: str, *values: float) -> int:
        """Remove records; return how many bytes they had."""
        return sum(length for (length,) in self._database.execute(statement, values).fetchall())

    def add_figures(self, now: float, figures: dict[str, float]) -> None:
        """Write figures of the fleet, seconds since 1970; remove those of yesterday, and of later times.

        Raises:
            sqlite3.Error: They cannot be written.
        """
        with self._lock, self._database:
            outside = (now - FIGURES_LAST_S, now)
            self._database.execute("DELETE FROM figures WHERE time < ? OR time > ?", outside)
            self._database.execute("INSERT OR REPLACE INTO figures VALUES (?, ?)", (now, json.dumps(figures)))

    def figures(self, since: float) -> list[tuple[float, dict[str, float]]]:
        """Return the figures from a time on, seconds since 1970, the oldest first."""
        query = "SELECT time, data FROM figures WHERE time >= ? ORDER BY time"
        with self._lock:
            rows = self._database.execute(query, (since,)).fetchall()
        return [(moment, json.loads(data)) for moment, data in rows]

    def range(self) -> tuple[float, float] | None:
        """Return the times of the first and the last record, seconds since 1970; None if there is none."""
        with self._lock:
            ((first, last),) = self._database.execute("SELECT MIN(time), MAX(time) FROM records")
        return None if first is None else (first, last)

    def read(self, at: float, seconds: float) -> list[Frame]:
        """Return the state at a time, and what changed after it.

        Args:
            at: Seconds since 1970; before the first record, that is the first state.
            seconds: How much time to return.

        Returns:
            Frames with ``time``; the first one is whole. Empty if nothing is recorded.
        """
        ((start,),) = self._database.execute("SELECT MAX(time) FROM records WHERE whole AND time <= ?", (at,))
        if start is None:
            ((start,),) = self._database.execute("SELECT MIN(time) FROM records WHERE whole")
        if start is None:
            return []
        at = max(at, start)
        whole: Frame = {"time": at, "robots": {}, "blocked": [], "pending": []}
        later: list[Frame] = []
        for moment, frame in self._between(start, at + seconds):
            if moment <= at:
                _merge(whole, frame)
            elif len(later) < MOST_FRAMES:
                later.append({"time": moment, **frame})
        return [whole, *later]

    def _between(self, first: float, last: float) -> Iterator[tuple[float, Frame]]:
        query = "SELECT time, data FROM records WHERE time BETWEEN ? AND ? ORDER BY time"
        with closing(self._database.execute(query, (first, last))) as rows:
            for moment, data in rows:
                yield moment, json.loads(zlib.decompress(data))

    def close(self) -> None:
        """Close the file."""
        self._database.close()


def replay_file(folder: Path, fleet: str) -> Path:
    """Return the file of a fleet's records where the user names none.

    Args:
        folder: The folder.
        fleet: What tells the fleet from others.
    """
    return fleet_file(folder, "replay", fleet, "sqlite")


def open_records(named: Path | None, default: Path | None = None) -> Records:
    """Return the records of a file; in memory if it cannot be used, which is logged.

    Args:
        named: The file that the user named; it has all records that fit.
        default: Else this one, which is made with its folder, and has those of :data:`RECORDS_LAST_S`.
    """
    try:
        if named is not None or default is None:
            return Records(named)
        make_private(default)
        return Records(default, last_s=RECORDS_LAST_S)
    except (sqlite3.Error, OSError) as error:
        _log.error(
            "replays are kept in memory only: %s cannot be used: %s; end another station that uses it, move"
            " it away, or name another file",
            named or default,
            error,
        )
        return Records()


def _merge(state: Frame, frame: Frame) -> None:
    """Apply a record to a complete state."""
    if frame.get("whole"):
        state["robots"] = {}
    state["robots"].update(frame["robots"])
    for robot in frame.get("removed", ()):
        state["robots"].pop(robot, None)
    state |= {key: frame[key] for key in ("blocked", "pending") if key in frame}


def _ignore(text: str, tone: str) -> None:
    del text, tone


class Recorder:
    """Records a fleet's view.

    Args:
        view: What is recorded.
        records: Where.
        on_event: Called with text and tone when records cannot be written, and when they can again.
    """

    def __init__(
        self, view: FleetView, records: Records, on_event: Callable[[str, str], None] = _ignore
    ) -> None:
        self.records = records
        self._view = view
        self._on_event = on_event
        self._fails = False
        self._taken_at = float("-inf")
        self._last: dict[str, list[Any]] = {}
        self._cells: dict[str, list[int]] = {}
        self._whole_at = float("-inf")

    async def run(self) -> None:
        """Write records until cancelled. On a full disk, it begins anew once there is room."""
        while True:
            await asyncio.sleep(RECORD_EVERY_S)
            made = self.take(time.time())
            if made is None:
                continue
            now, frame, whole = made
            try:
                await asyncio.to_thread(self.records.add, now, frame, whole=whole)
            except sqlite3.Error as error:
                self._whole_at = float("-inf")  # the next record cannot be a change of this one
                self._tell(f"nothing is recorded for replays now: {error}")
            else:
                self._tell("")

    def _tell(self, trouble: str) -> None:
        """Tell that records cannot be written, or can again, once."""
        if bool(trouble) is self._fails:
            return
        self._fails = bool(trouble)
        text = trouble or "the recording for replays continues"
        _log.log(logging.WARNING if trouble else logging.INFO, "%s", text)
        self._on_event(text, "bad" if trouble else "good")

    def take(self, now: float) -> tuple[float, Frame, bool] | None:
        """Return the record of this moment, and whether it is whole; None if nothing changed.

        Args:
            now: Seconds since 1970.
        """
        if self._view.map() is None:
            return None
        # A clock that is set back begins anew, too.
        whole = now < self._taken_at or now - self._whole_at >= WHOLE_EVERY_S
        self._taken_at = now
        robots = {robot["id"]: self._row(robot) for robot in self._view.robots()}
        cells = {"blocked": self._view.blocked(), "pending": self._view.pending()}
        frame: Frame = {
            "robots": robots
            if whole
            else {robot: row for robot, row in robots.items() if self._last.get(robot) != row}
        }
        if gone := sorted(self._last.keys() - robots.keys()):
            frame["removed"] = gone
        if whole or cells != self._cells:
            frame |= cells
        if whole:
            frame["whole"] = True
            self._whole_at = now
        self._last, self._cells = robots, cells
        return (now, frame, whole) if whole or len(frame) > 1 or frame["robots"] else None

    def _row(self, robot: dict[str, Any]) -> list[Any]:
        """Return x, y (metres), yaw (radians), state, cell, goal and the last granted cell."""
        pose = robot["pose"]
        place = [None] * 3 if pose is None else [round(pose[key], 2) for key in ("x", "y", "theta")]
        return [*place, robot["state"], robot["cell"], robot["goal"], robot["granted"][-1:]]
