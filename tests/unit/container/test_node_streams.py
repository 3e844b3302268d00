"""A node's log: what comes from where is kept apart, in the order in which it came."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.control.logs import LogLevel, LogStream
from rce.ros.logrecord import KIND, Level, LogRecord
from rce.ros.types import Time, TypeRegistry
from rce_container.environment.logs import rosout as rosout_module
from rce_container.environment.logs.files import ROSOUT_LOG, LogWriter
from rce_container.environment.logs.node_log import NodeLog
from rce_container.environment.logs.rosout import RosoutLog
from rce_container.environment.logs.streams import FRAGMENT_BYTES, letters_of, whole_characters
from rce_container.logs import read_log, read_node_log

OUT, ERR, ROS, ENGINE = LogStream.STDOUT, LogStream.STDERR, LogStream.ROSOUT, LogStream.ENGINE
LOG = TypeRegistry().message(KIND)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[NodeLog]:
    log = NodeLog(tmp_path, "n")
    yield log
    log.close()


def read(folder: Path, *streams: LogStream, level: LogLevel = LogLevel.DEBUG, limit: int = 1) -> str:
    """Read all, in as small pieces as there can be."""
    text, offset = "", 0
    while True:
        chunk = read_node_log(folder, "n", offset, limit, letters_of(streams, level))
        if chunk.offset == offset:
            return text
        text, offset = text + chunk.text, chunk.offset


def record(level: int, text: str, name: str = "/n") -> LogRecord:
    return LogRecord(7, 5000, level, name, text, "f.py", "main", 1, ())


def test_streams_are_told_apart_and_stay_in_order(tmp_path: Path, log: NodeLog) -> None:
    log.stdout(b"one\ntwo\n")
    log.stderr(b"oops\n")
    log.record(record(Level.WARN, "careful"))
    log.stdout(b"x-- ended: exit code 0 --\n")
    log.note("ended: exit code 3")
    assert read(tmp_path) == (
        "one\ntwo\noops\n[WARN] [7.000005]: careful\nx-- ended: exit code 0 --\n-- ended: exit code 3 --\n"
    )
    assert read(tmp_path, OUT) == "one\ntwo\nx-- ended: exit code 0 --\n"
    assert read(tmp_path, ERR) == "oops\n"
    assert read(tmp_path, ROS) == "[WARN] [7.000005]: careful\n"
    assert read(tmp_path, ENGINE) == "-- ended: exit code 3 --\n"
    assert read(tmp_path, ERR, ENGINE) == "oops\n-- ended: exit code 3 --\n"


def test_records_are_chosen_by_how_serious_they_are(tmp_path: Path, log: NodeLog) -> None:
    for level in Level:
        log.record(record(level, level.name.lower()))
    log.record(record(3, "between"))
    log.record(record(0, "below"))
    log.stdout(b"printed\n")
    for least in LogLevel:
        found = read(tmp_path, ROS, level=least)
        wanted = [one for one in Level if one >= Level[least.name]]
        assert [one for one in Level if f": {one.name.lower()}\n" in found] == wanted
    assert "between" in read(tmp_path, ROS, level=LogLevel.INFO)
    assert "between" not in read(tmp_path, ROS, level=LogLevel.WARN)
    assert "below" not in read(tmp_path, ROS, level=LogLevel.INFO)
    assert "printed" in read(tmp_path, level=LogLevel.FATAL)


def test_a_record_of_several_lines_is_one_stream(tmp_path: Path, log: NodeLog) -> None:
    log.record(record(Level.ERROR, "a\nb"))
    assert read(tmp_path, ROS, level=LogLevel.ERROR) == "[ERROR] [7.000005]: a\nb\n"


def test_a_line_is_seen_before_it_ends(tmp_path: Path, log: NodeLog) -> None:
    log.stdout(b"50%")
    assert read(tmp_path) == "50%"
    log.stdout(b" 100%\n")
    assert read(tmp_path) == "50% 100%\n"
    log.stdout(b"more")
    log.note("ended: exit code 0")
    assert read(tmp_path).endswith("more\n-- ended: exit code 0 --\n")


def test_last_words_are_of_the_errors_first_and_of_one_life(log: NodeLog) -> None:
    log.stderr(b"Traceback\nValueError: bad\n\n")
    log.stdout(b"bye\n")
    assert log.last_output == "ValueError: bad"
    log.begin()
    log.stdout(b"bye\n")
    assert log.last_output == "bye"


@given(
    st.lists(
        st.tuples(st.sampled_from([OUT, ERR]), st.binary(max_size=30) | st.text(max_size=20).map(str.encode)),
        max_size=30,
    ),
    st.integers(1, 100),
)
def test_nothing_is_lost_mixed_up_or_forged(
    tmp_path_factory: pytest.TempPathFactory, writes: list[tuple[LogStream, bytes]], limit: int
) -> None:
    folder = tmp_path_factory.mktemp("logs")
    log = NodeLog(folder, "n")
    for stream, data in writes:
        (log.stdout if stream is OUT else log.stderr)(data)
    log.note("end")
    log.close()
    for stream in (OUT, ERR):
        whole = b"".join(data for one, data in writes if one is stream)
        if whole and not whole.endswith(b"\n"):
            whole += b"\n"
        assert read(folder, stream, limit=limit) == whole.decode(errors="replace")
    assert read(folder, ENGINE, limit=limit) == "-- end --\n"


@given(st.text(max_size=40), st.integers(0, 200))
def test_characters_are_cut_off_whole(text: str, at: int) -> None:
    data = text.encode()[:at]
    whole = whole_characters(data)
    data[:whole].decode()
    assert len(data) - whole <= 3


@pytest.mark.parametrize("letter", ["x", "ü", "🤖"])
def test_endless_lines_are_kept_in_parts(tmp_path: Path, log: NodeLog, letter: str) -> None:
    line = letter * (3 * FRAGMENT_BYTES)
    log.stdout(line.encode() + b"\nnext\n")
    assert read(tmp_path) == line + "\nnext\n"
    raw = (tmp_path / "n.000000000000.log").read_bytes()
    assert max(map(len, raw.split(b"\n"))) <= FRAGMENT_BYTES + 1


def test_an_offset_within_a_line_means_the_next(tmp_path: Path, log: NodeLog) -> None:
    log.stdout(b"first line\nsecond line\n")
    for back in range(1, len("osecond line\n") + 1):
        chunk = read_node_log(tmp_path, "n", -back, 100, letters_of(()))
        assert chunk.text == ("second line\n" if back == len("osecond line\n") else "")
    end = chunk.offset
    log.stdout(b"third\n")
    assert read_node_log(tmp_path, "n", end, 100, letters_of(())).text == "third\n"


def test_what_rotation_left_begins_with_a_whole_line(tmp_path: Path, log: NodeLog) -> None:
    line = b"x" * 99 + b"\n"
    for _ in range(400):
        log.stdout(line * 100)
    text = read(tmp_path, limit=1 << 16)
    assert 1 << 20 < len(text) < 3 << 20
    assert set(text.splitlines()) == {"x" * 99}


def test_a_full_disk_loses_what_did_not_fit_and_nothing_after_it(
    tmp_path: Path, log: NodeLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    import os

    write = os.write
    with monkeypatch.context() as patch:
        patch.setattr("os.write", lambda fd, data: write(fd, data[:5]))
        log.stdout(b"a line that is cut off\n")
    log.stderr(b"and one that is not\n")
    assert read(tmp_path, ERR) == "and one that is not\n"
    assert read(tmp_path, OUT).startswith("a li")


def test_what_no_environment_wrote_does_not_stop_a_reader(tmp_path: Path) -> None:
    (tmp_path / "n.000000000000.log").write_bytes(b"?" * 100_000 + b"\nofine\n?\n\n")
    assert read(tmp_path) == "fine\n"


# Records in ROS


def payload(name: str, text: str) -> bytes:
    return LOG.serialize(
        LOG.new(
            header={"stamp": Time(7, 0)}, level=4, name=name, msg=text, file="f.py", function="main", line=1
        )
    )


class Rosout:
    def __init__(self, folder: Path, log: NodeLog) -> None:
        self.now = 0.0
        self.logs = {"/known": log}
        self.log = RosoutLog(folder, self.logs.get, lambda: self.now)


@pytest.fixture
def rosout(tmp_path: Path, log: NodeLog) -> Rosout:
    return Rosout(tmp_path, log)


def test_records_go_to_node_logs_and_rosout_log(
    tmp_path: Path, rosout: Rosout, caplog: pytest.LogCaptureFixture
) -> None:
    """Records go to their nodes and to one log like ros has it."""
    rosout.log.take(payload("/known", "hello"))
    rosout.log.take(payload("/another", "hi"))
    rosout.log.take(b"nonsense")
    assert "no log record" in caplog.text
    assert read(tmp_path) == "[WARN] [7.000000]: hello\n"
    lines = read_log(tmp_path, ROSOUT_LOG, 0, 10_000).text.splitlines()
    assert lines[2].endswith("  Node Startup")
    assert lines[3:] == [
        "7.000000000 WARN /known [f.py:1(main)] [topics: ] hello",
        "7.000000000 WARN /another [f.py:1(main)] [topics: ] hi",
    ]
    rosout.log.close()


def test_records_of_a_node_that_is_not_known_yet_wait_for_it(tmp_path: Path, rosout: Rosout) -> None:
    rosout.log.take(payload("/late", "first"))
    rosout.log.take(payload("/never", "lost"))
    rosout.log.known("/late")
    assert read(tmp_path) == ""
    rosout.logs["/late"] = rosout.logs["/known"]
    rosout.log.known("/late")
    rosout.log.known("/late")
    assert read(tmp_path) == "[WARN] [7.000000]: first\n"
    rosout.log.close()


def test_a_flood_of_records_is_counted_and_hurts_no_other_node(
    tmp_path: Path, rosout: Rosout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rosout_module, "WINDOW_BYTES", 1000)
    for _ in range(100):
        rosout.log.take(payload("/known", "x" * 50))
    rosout.log.take(payload("/another", "still here"))
    kept = read(tmp_path).count("\n")
    assert 0 < kept < 20
    assert "still here" in read_log(tmp_path, ROSOUT_LOG, 0, 100_000).text
    rosout.now = 2.0
    rosout.log.take(payload("/known", "again"))
    text = read(tmp_path)
    assert f"-- {100 - kept} log records came too fast and were not kept --\n" in text
    assert text.endswith("again\n")
    rosout.log.close()


def test_writers_share_nothing(tmp_path: Path) -> None:
    logs = [LogWriter(tmp_path, name) for name in ("n", "nn")]
    for log in logs:
        log.write(b"on\n")
        log.close()
    assert read(tmp_path) == "n\n"
