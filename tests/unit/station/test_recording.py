"""What the station records of a fleet, and how it is replayed."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from support.planner_states import changes, pose, robot, state

from rce.aio.tasks import cancel_and_wait
from rce_fleet.station import recording
from rce_fleet.station.recording import (
    RECORDS_LAST_S,
    WHOLE_EVERY_S,
    Frame,
    Recorder,
    Records,
    open_records,
    replay_file,
)
from rce_fleet.station.view import FleetView

START = 1000.0


@pytest.fixture
def view() -> FleetView:
    made = FleetView()
    made.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[5]))
    made.on_pose("Robot1", pose(1.0, 0.5, 0.0))
    return made


@pytest.fixture
def records() -> Iterator[Records]:
    with closing(Records()) as kept:
        yield kept


def record(recorder: Recorder, now: float) -> bool:
    """Record a moment; return whether there was something."""
    made = recorder.take(now)
    if made is not None:
        recorder.records.add(made[0], made[1], whole=made[2])
    return made is not None


def test_the_state_of_any_moment_is_known(view: FleetView, records: Records) -> None:
    recorder = Recorder(view, records)
    for second in range(100):
        view.on_pose("Robot1", pose(0.1 * second, 0.5, 0.0))
        if second == 50:
            view.on_changes(changes(robot("Robot2", goal=7), blocked=[6], freed=[5]))
        record(recorder, START + second)
    assert recorder.records.range() == (START, START + 99)
    whole, *later = recorder.records.read(START + 45.5, 10.0)
    assert whole["time"] == START + 45.5
    assert whole["robots"]["Robot1"][:2] == [4.5, 0.5]
    assert (whole["blocked"], whole["robots"]["Robot2"][5]) == ([5], None)
    assert [frame["time"] for frame in later] == [START + second for second in range(46, 56)]
    changed = next(frame for frame in later if "blocked" in frame and not frame.get("whole"))
    assert (changed["time"], changed["blocked"], changed["robots"]["Robot2"][5]) == (START + 50, [6], 7)
    assert recorder.records.read(START + 70, 0.0)[0]["blocked"] == [6]


def test_a_clock_that_is_set_back_begins_with_a_whole_record(view: FleetView, records: Records) -> None:
    """A machine whose clock was ahead would replay yesterday's robots, for as long as it was ahead."""
    recorder = Recorder(view, records)
    record(recorder, START + 7200)
    view.on_pose("Robot1", pose(3.0, 0.5, 0.0))
    record(recorder, START)
    whole = recorder.records.read(START, 10.0)[0]
    assert (whole["time"], whole["robots"]["Robot1"][:2]) == (START, [3.0, 0.5])
    assert set(whole["robots"]) == {"Robot1", "Robot2"}


def test_a_clock_that_is_set_back_takes_its_own_records_back(view: FleetView) -> None:
    """A replay would mix both times. At its bound, each new record was the first to make room."""
    with closing(Records(limit=3000)) as records:
        recorder = Recorder(view, records)
        for second in range(200):
            view.on_pose("Robot1", pose(0.1 * second, 0.5, 0.0))
            record(recorder, START + 7200 + second)
        for second in range(100):
            view.on_pose("Robot1", pose(50.0 + second, 0.5, 0.0))
            record(recorder, START + 7100 + second)
        assert (records.range() or (0.0, 0.0))[1] == START + 7199
        assert records.read(START + 7190.5, 0.0)[0]["robots"]["Robot1"][0] == 140.0
        assert len(records.read(START + 7190.5, 10.0)) == 10


def test_a_clock_that_is_set_back_a_little_begins_anew(view: FleetView, records: Records) -> None:
    recorder = Recorder(view, records)
    for moment in (0, 1, 2, 3, 1.5):
        view.on_pose("Robot1", pose(moment, 0.5, 0.0))
        record(recorder, START + moment)
    assert records.range() == (START, START + 1.5)


class FullDisk(Records):
    """Refuses some records."""

    refuses = 2

    def add(self, now: float, frame: Frame, *, whole: bool) -> None:
        if self.refuses:
            self.refuses -= 1
            raise sqlite3.OperationalError("database or disk is full")
        super().add(now, frame, whole=whole)


async def test_a_full_disk_does_not_end_the_recording(
    view: FleetView, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It begins with a whole record once there is room; the page is told of both."""
    monkeypatch.setattr(recording, "RECORD_EVERY_S", 0.01)
    told: list[tuple[str, str]] = []
    with closing(FullDisk()) as records:
        running = asyncio.create_task(Recorder(view, records, lambda *event: told.append(event)).run())
        async with asyncio.timeout(60):
            while not running.done() and len(told) < 2:
                await asyncio.sleep(0.01)
        await cancel_and_wait(running)
        span = records.range()
        assert span is not None
        assert set(records.read(span[0], 0.0)[0]["robots"]) == {"Robot1", "Robot2"}
    assert told == [
        ("nothing is recorded for replays now: database or disk is full", "bad"),
        ("the recording for replays continues", "good"),
    ]


def test_figures_of_later_times_are_removed(records: Records) -> None:
    """They are of a clock that was ahead."""
    for moment in (START, START + 3600, START + 10):
        records.add_figures(moment, {"moving": 1.0})
    assert [moment for moment, _ in records.figures(0.0)] == [START, START + 10]


def test_nothing_is_written_while_nothing_changes(view: FleetView, records: Records) -> None:
    recorder = Recorder(view, records)
    assert [record(recorder, START + second) for second in range(5)] == [True, False, False, False, False]
    assert record(recorder, START + WHOLE_EVERY_S), "but a whole record, now and then"


def test_a_removed_robot_is_gone_in_the_replay(view: FleetView, records: Records) -> None:
    recorder = Recorder(view, records)
    record(recorder, START)
    view.on_changes(changes(removed=["Robot2"]))
    record(recorder, START + 1)
    assert set(recorder.records.read(START, 0.0)[0]["robots"]) == {"Robot1", "Robot2"}
    assert set(recorder.records.read(START + 1, 0.0)[0]["robots"]) == {"Robot1"}


def test_a_file_stays_within_its_bound(view: FleetView, tmp_path: Path) -> None:
    """The newest records survive a restart of the station; the oldest make room."""
    file, limit = tmp_path / "history", 20_000
    recorder = Recorder(view, Records(file, limit))
    for second in range(1000):
        view.on_pose("Robot1", pose(0.1 * second, 0.01 * second, 0.0))
        record(recorder, START + second)
    recorder.records.close()
    again = Records(file, limit)
    span = again.range()
    assert span is not None
    assert span[0] > START + 100
    assert span[1] == START + 999
    assert again.read(span[1], 0.0)[0]["robots"]["Robot1"][0] == pytest.approx(99.9)
    again.close()


def drive_for(recorder: Recorder, view: FleetView, first: float, seconds: int) -> None:
    """Record a robot that drives from a time on."""
    for second in range(seconds):
        view.on_pose("Robot1", pose(0.1 * second, 0.5, 0.0))
        record(recorder, first + second)


def test_the_default_file_outlives_the_station(view: FleetView, tmp_path: Path) -> None:
    """It is made, with its folder, and only its owner reads it; each fleet has its own."""
    file = replay_file(tmp_path / "state" / "station", "here")
    with closing(open_records(None, file)) as records:
        drive_for(Recorder(view, records), view, START, 5)
    assert (file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    with closing(open_records(None, file)) as again:
        assert again.range() == (START, START + 4)
    assert replay_file(tmp_path, "here") != replay_file(tmp_path, "there")


def test_the_default_file_has_the_last_day(view: FleetView, tmp_path: Path) -> None:
    """A slider over the weeks of a small fleet would not find a moment. A file that is named keeps them."""
    later = START + RECORDS_LAST_S + 60
    for name, default, first in (("named", None, START), ("default", tmp_path / "default", START + 60)):
        with closing(open_records(tmp_path / name if default is None else None, default)) as records:
            recorder = Recorder(view, records)
            drive_for(recorder, view, START, 100)
            drive_for(recorder, view, later, 2)
            assert records.range() == (first, later + 1)
            assert records.read(later, 0.0)[0]["robots"]["Robot1"][0] == 0.0


def test_a_file_is_of_one_station(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Changes of one would be taken for changes of the state that the other wrote."""
    monkeypatch.setattr(recording, "IN_USE_S", 0.0)
    file = tmp_path / "replay"
    with closing(open_records(None, file)) as first:
        first.add(START, {"robots": {}}, whole=True)
        with closing(open_records(None, file)) as second:
            assert second.range() is None
        assert f"replays are kept in memory only: {file} cannot be used" in caplog.text
        first.add(START + 1, {"robots": {}}, whole=True)
    with closing(open_records(None, file)) as again:
        assert again.range() == (START, START + 1)


def test_nothing_is_recorded_before_the_first_state(records: Records) -> None:
    recorder = Recorder(FleetView(), records)
    assert recorder.take(START) is None
    assert recorder.records.range() is None
    assert recorder.records.read(START, 10.0) == []


@pytest.mark.parametrize("is_named", [True, False])
@pytest.mark.parametrize("name", ["text.db", "text.db/history.db", "."])
def test_a_file_that_cannot_be_used_does_not_keep_the_station_from_starting(
    tmp_path: Path, name: str, is_named: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """A damaged recording for replays must not take the emergency stops with it."""
    (tmp_path / "text.db").write_text("this is text" * 100)
    file = tmp_path / name
    with closing(open_records(file) if is_named else open_records(None, file)) as records:
        records.add(START, {"robots": {}}, whole=True)
        assert records.range() == (START, START)
    assert "replays are kept in memory only" in caplog.text
    assert str(tmp_path / name) in caplog.text
