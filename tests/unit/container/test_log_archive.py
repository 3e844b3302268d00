"""The logs of containers that live, and for a while of those that ended."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rce.control.logs import LogQuery, LogStream
from rce.control.messages import ReadLog
from rce_container.archive import MAX_INCARNATIONS, LogArchive
from rce_container.environment.logs.files import ENVIRONMENT_LOG, ROSOUT_LOG, LogWriter
from rce_container.environment.logs.node_log import NodeLog
from rce_container.exceptions import StateError
from rce_container.folder import StateFolder
from rce_container.reading import read_for

BOX = "anna/box"
DAY = 86400.0


@pytest.fixture
def archive(tmp_path: Path) -> LogArchive:
    return LogArchive(tmp_path / "logs", days=3.0, space=10_000)


def live(archive: LogArchive, incarnation_id: str, text: str = "hello", id_: str = BOX) -> None:
    """Begin a life and write its logs."""
    folder = archive.begin(id_, incarnation_id, 1.0)
    for name in (ENVIRONMENT_LOG, ROSOUT_LOG):
        writer = LogWriter(folder, name)
        writer.write(f"{name} of {incarnation_id}\n".encode())
        writer.close()
    log = NodeLog(folder, "node")
    log.stdout(f"{text}\n".encode())
    log.note("ended: exit code 3")
    log.close()


def read(archive: LogArchive, node: str = "node", living: str = "", id_: str = BOX, **query: object) -> str:
    message = ReadLog(request=1, id=id_, node=node, query=LogQuery(**query))  # type: ignore[arg-type]  # any of its fields
    return read_for(archive, message, living).text


def incarnation_ids(archive: LogArchive, id_: str = BOX) -> list[str]:
    return [kept.record.incarnation_id for kept in archive.ended(id_)]


def test_a_life_is_read_while_it_lives_and_after_it(archive: LogArchive) -> None:
    live(archive, "one")
    assert read(archive, living="one", streams=(LogStream.STDOUT,)) == "hello\n"
    with pytest.raises(FileNotFoundError, match="no logs of an earlier life of container box"):
        read(archive, living="one", previous=True)
    archive.end(BOX, "one", "destroyed by its user", 10.0)
    archive.end(BOX, "one", "something else", 11.0)
    assert read(archive) == "hello\n-- ended: exit code 3 --\n"
    chunk = read_for(archive, ReadLog(request=1, id=BOX, node="node"), "")
    assert (chunk.incarnation, chunk.ended, chunk.reason) == ("one", 10.0, "destroyed by its user")
    live(archive, "two", "again")
    assert read(archive, living="two", streams=(LogStream.STDOUT,)) == "again\n"
    assert read(archive, living="two", previous=True).startswith("hello")
    assert read(archive, living="two", incarnation="one").startswith("hello")
    assert read(archive, living="two", incarnation="two").startswith("again")
    with pytest.raises(FileNotFoundError, match="not kept any more"):
        read(archive, living="two", incarnation="three")


def test_the_environment_has_two_logs(archive: LogArchive) -> None:
    live(archive, "one")
    assert read(archive, "", living="one") == "_environment of one\n"
    assert read(archive, "", living="one", streams=(LogStream.ROSOUT,)) == "_rosout of one\n"


def test_nobody_reads_what_is_another_ones(archive: LogArchive) -> None:
    live(archive, "one", id_="bob/box")
    archive.end("bob/box", "one", "", 10.0)
    for query in ({}, {"incarnation": "one"}, {"previous": True}):
        with pytest.raises(FileNotFoundError):
            read(archive, **query)
    for node in ("../one/node", "_environment", "", "*"):
        with pytest.raises(FileNotFoundError):
            read(archive, node)
    with pytest.raises(FileNotFoundError):
        read(archive, id_="bob/box", since=9.5)
    assert read(archive, id_="bob/box", since=1.0)


def test_ending_parts_of_removed_user_stay_theirs(archive: LogArchive) -> None:
    """What still ends of a user who was removed is not another ones."""
    live(archive, "one")
    assert read(archive, living="one", since=1.0)
    for query in ({}, {"incarnation": "one"}):
        with pytest.raises(FileNotFoundError):
            read(archive, living="one", since=1.5, **query)


def test_the_last_life_that_ended_counts(archive: LogArchive) -> None:
    for number, incarnation_id in enumerate(("b", "a", "c")):
        live(archive, incarnation_id, incarnation_id)
        archive.end(BOX, incarnation_id, "", 10.0 + number)
    assert incarnation_ids(archive) == ["c", "a", "b"]
    assert read(archive).startswith("c\n")


def test_old_lives_are_removed_with_all_that_was_theirs(archive: LogArchive, tmp_path: Path) -> None:
    live(archive, "old", id_="bob/box")
    archive.end("bob/box", "old", "", 10.0)
    live(archive, "alive", id_="anna/other")
    live(archive, "new")
    archive.end(BOX, "new", "", 10.0 + 2 * DAY)
    archive.prune(10.0 + 3 * DAY)
    assert incarnation_ids(archive, "bob/box") == ["old"]
    archive.prune(11.0 + 3 * DAY)
    assert incarnation_ids(archive, "bob/box") == []
    assert not (tmp_path / "logs" / "bob").exists()
    assert incarnation_ids(archive) == ["new"]
    assert archive.find("alive") is not None


def test_the_oldest_go_when_there_is_too_much(archive: LogArchive) -> None:
    live(archive, "alive", "x" * 50_000, "anna/other")
    for number in range(4):
        live(archive, f"m{number}", "x" * 3000)
        archive.end(BOX, f"m{number}", "", 10.0 + number)
    archive.prune(20.0)
    assert incarnation_ids(archive) == ["m3", "m2", "m1"]
    assert archive.find("alive") is not None, "what lives does not count"


def test_dying_container_does_not_fill_the_archive(archive: LogArchive) -> None:
    """A container that dies again and again does not fill the archive."""
    for number in range(MAX_INCARNATIONS + 5):
        live(archive, f"m{number}")
        archive.end(BOX, f"m{number}", "", 10.0 + number)
    archive.prune(20.0)
    assert incarnation_ids(archive) == [f"m{number}" for number in reversed(range(5, MAX_INCARNATIONS + 5))]


def test_half_written_records_are_removed_at_the_start(archive: LogArchive, tmp_path: Path) -> None:
    """What a manager leaves that is killed while it writes a record."""
    live(archive, "one")
    logs = tmp_path / "logs"
    (logs / BOX / "one.json.new").write_bytes(b"{")
    (logs / "bob" / "box").mkdir(parents=True)
    (logs / "bob" / "box" / "two.json.new").touch()
    (logs / "carl" / "box").mkdir(parents=True)
    archive.settle({"one"}, 10.0)
    assert sorted(str(path.relative_to(logs)) for path in logs.rglob("*.new")) == []
    assert [path.name for path in logs.iterdir()] == ["anna"]
    assert read(archive, living="one", streams=(LogStream.STDOUT,)) == "hello\n"


def test_the_end_of_what_nobody_saw_end_is_noted_later(archive: LogArchive) -> None:
    live(archive, "there")
    live(archive, "gone")
    archive.settle({"there"}, 10.0)
    (kept,) = archive.ended(BOX)
    assert (kept.record.incarnation_id, kept.record.ended) == ("gone", 10.0)
    assert kept.record.reason == "no manager saw it end; its last output: _environment of gone"
    archive.settle_one("there", 11.0)
    archive.settle_one("unknown", 11.0)
    assert incarnation_ids(archive) == ["there", "gone"]


def test_a_disk_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("no folder")
    with pytest.raises(StateError, match="cannot make"):
        LogArchive(tmp_path / "logs", days=1, space=1).begin(BOX, "one", 1.0)


def test_a_records_text_is_not_believed(archive: LogArchive, tmp_path: Path) -> None:
    live(archive, "one")
    record = tmp_path / "logs" / BOX / "one.json"
    for text in ("", "{}", '{"id": "anna/box", "mark": "two", "began": 1, "ended": 2}'):
        record.write_text(text)
        assert incarnation_ids(archive) == []


def test_what_vanishes_while_it_is_looked_at_is_passed_over(
    archive: LogArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    for user in ("anna", "bob"):
        live(archive, f"of_{user}", id_=f"{user}/box")
    list_folder = Path.iterdir

    def iterdir(path: Path) -> Iterator[Path]:
        if path.name == "logs":
            return iter([*list_folder(path), path / "gone"])
        return list_folder(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert set(archive.folders()) == {"of_anna", "of_bob"}
    archive.settle((), 10.0)
    archive.prune(20.0)
    assert archive.get("anna/box", "of_anna") is not None
    assert archive.get("bob/box", "of_anna") is None
    assert archive.find("of_bob") is not None


def test_the_logs_of_a_state_folder_outlive_the_container(tmp_path: Path) -> None:
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        folder = state.create(BOX)
        (folder.logs / "node.000000000000.log").write_bytes(b"ohello\n")
        assert [one.logs for one in state.existing()] == [folder.logs]
        folder.remove()
        state.archive.end(BOX, folder.incarnation_id, "destroyed", 10.0)
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        assert read(state.archive) == "hello\n"
        assert (tmp_path / "state" / "logs").stat().st_mode & 0o077 == 0
