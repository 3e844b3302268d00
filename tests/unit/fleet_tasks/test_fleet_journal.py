"""The journal of the fleet manager: what it keeps, and what it refuses."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest

from rce_fleet.exceptions import JournalError
from rce_fleet.journal import journal as journals
from rce_fleet.journal.journal import EventQuery, Journal
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import BlockedCells, Places, RobotEntry, RobotProfile, Zone

ORDER = Order((Stop(Action.PICK, (3,), 2.0), Stop(Action.DELIVER, (12, 13))), every=60.0)


def filled() -> TaskBook:
    book = TaskBook()
    book.create(ORDER, 1.0, user="erp", key="k")
    book.hold("T1", 2.0, user="anna")
    book.emit(
        RobotEntry("Robot1", mode="out_of_service", profile=RobotProfile(("lift",), 50.0)), "taken out", 3.0
    )
    book.emit(Places((1, 2)), "places", 4.0)
    book.emit(Zone("aisle", "slow", (4, 5), 0.2), "zone", 5.0)
    book.emit(BlockedCells((7,)), "blocked", 6.0)
    return book


def test_records_are_the_same_after_loading(tmp_path: Path) -> None:
    book = filled()
    journal = Journal(tmp_path / "j.sqlite")
    journal.append(book.take_events())
    journal.close()
    again = Journal(tmp_path / "j.sqlite")
    records, last = again.load()
    copy = TaskBook()
    for record in records:
        copy.put_record(record)
    assert last == 6
    assert copy.tasks == book.tasks
    assert (copy.robots, copy.places, copy.zones, copy.blocked) == (
        *(book.robots, book.places, book.zones, book.blocked),
    )
    again.close()


def test_a_new_file_is_another_journal(tmp_path: Path) -> None:
    first, other = Journal(tmp_path / "j.sqlite"), Journal(tmp_path / "k.sqlite")
    first.close()
    again = Journal(tmp_path / "j.sqlite")
    assert (again.id == first.id, other.id == first.id) == (True, False)
    again.close()
    other.close()


def test_events_are_found_by_number_time_and_id(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.sqlite")
    journal.append(filled().take_events())
    assert [event["number"] for event in journal.events(EventQuery(after=4))] == [5, 6]
    assert [event["name"] for event in journal.events(EventQuery(id="T1"))] == ["created", "held"]
    assert [event["number"] for event in journal.events(EventQuery(since=2.0, until=4.0))] == [2, 3]
    assert [event["number"] for event in journal.events(EventQuery(kinds=("task", "zone")))] == [1, 2, 5]
    assert [event["number"] for event in journal.events(EventQuery(robot="Robot1"))] == [3]
    assert journal.events(EventQuery(kinds=("task",), robot="Robot1")) == []
    assert len(journal.events(EventQuery(limit=3))) == 3
    journal.forget_events(5)
    assert [event["number"] for event in journal.events(EventQuery())] == [5, 6]
    journal.close()


def test_events_of_one_task_are_found_without_looking_at_all(tmp_path: Path) -> None:
    """The journal has 200 000 events, and those who wait for it to be written wait for the search, too."""
    book, journal = filled(), Journal(tmp_path / "j.sqlite")
    for _ in range(2000):
        book.create(ORDER, 9.0)
    journal.append(book.take_events())
    steps = [0]

    def count() -> int:
        steps[0] += 1
        return 0

    journal._db.set_progress_handler(count, 100)
    assert [event["name"] for event in journal.events(EventQuery(id="T1"))] == ["created", "held"]
    journal._db.set_progress_handler(None, 0)
    journal.close()
    assert steps[0] < 10


def test_a_newer_journal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j.sqlite"
    Journal(path).close()
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version = 7")
    db.close()
    with pytest.raises(JournalError, match=r"newer release \(schema 7; this release knows 3"):
        Journal(path)


@pytest.mark.parametrize(("former", "kind"), [("one-way", "one_way"), ("room", "limited"), ("slow", "slow")])
def test_zones_of_an_earlier_journal_are_converted(tmp_path: Path, former: str, kind: str) -> None:
    path = tmp_path / "j.sqlite"
    journal = Journal(path)
    journal.put([Zone("lift", former, (3, 4), 1.0, reason="narrow")])
    journal.close()
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version = 2")
    db.close()
    converted = Journal(path)
    assert converted.load()[0] == [Zone("lift", kind, (3, 4), 1.0, reason="narrow")]
    converted.close()


def test_a_damaged_journal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "j.sqlite"
    path.write_bytes(b"no database at all" * 100)
    with pytest.raises(JournalError, match="damaged"):
        Journal(path)


def test_a_second_manager_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journals, "LOCK_WAIT_S", 0.3)
    first = Journal(tmp_path / "j.sqlite")
    with pytest.raises(JournalError, match="used by another fleet manager"):
        Journal(tmp_path / "j.sqlite")
    first.close()
    Journal(tmp_path / "j.sqlite").close()


def test_a_full_disk_keeps_what_was_written(tmp_path: Path) -> None:
    """The limit of pages makes SQLite report what it reports on a full disk."""
    book = filled()
    journal = Journal(tmp_path / "j.sqlite")
    journal.append(book.take_events())
    pages = journal._db.execute("PRAGMA page_count").fetchone()[0]
    journal._db.execute(f"PRAGMA max_page_count = {pages}")
    for _ in range(200):
        book.create(ORDER, 9.0)
    with pytest.raises(JournalError, match="the disk is full"):
        journal.append(book.take_events())
    assert len(journal.events(EventQuery())) == 6
    assert len(journal.load()[0]) == 5
    journal.close()


def test_a_journal_of_the_first_version_is_converted(tmp_path: Path) -> None:
    path = tmp_path / "j.sqlite"
    Journal(path).close()
    old = [("Robot1", True, True), ("Robot2", False, True), ("Robot3", False, False)]
    with sqlite3.connect(path) as db:
        db.execute("DROP TABLE minutes")
        for name, is_out, is_paused in old:
            record = json.dumps({"id": name, "is_out": is_out, "is_paused": is_paused, "revision": 3})
            db.execute("INSERT INTO records VALUES ('robot', ?, ?)", (name, record.encode()))
        db.execute("PRAGMA user_version = 1")
    db.close()
    journal = Journal(path)
    modes = {each.id: each.mode for each in journal.load()[0] if isinstance(each, RobotEntry)}
    assert modes == {"Robot1": "out_of_service", "Robot2": "paused", "Robot3": "automatic"}
    assert journal.minutes() == []
    journal.close()
