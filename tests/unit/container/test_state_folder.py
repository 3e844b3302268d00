"""The state directory: a name that is kept, a lock, folders that are removed whole."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rce_container.exceptions import StateError
from rce_container.folder import Record, StateFolder


def test_the_name_is_kept(tmp_path: Path) -> None:
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        name = state.name("")
        assert state.name("") == name
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        assert state.name("") == name
        assert state.name("mine") == "mine"
        assert state.name("") == "mine"
        with pytest.raises(StateError, match="cannot name a task set"):
            state.name("a b")


def test_a_new_name_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a loss of power, a task set of another name would not have the volumes of this one."""
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(os.fstat(fd).st_ino))
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        for requested in ("", "mine"):
            state.name(requested)
            assert synced[-2:] == [
                (tmp_path / "state" / "name").stat().st_ino,
                (tmp_path / "state").stat().st_ino,
            ]
            synced.clear()


def test_the_newest_term_is_kept(tmp_path: Path) -> None:
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        assert state.term == 0
        state.keep_term(12)
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        assert state.term == 12
        (tmp_path / "state" / "term").write_text("newest")
        with pytest.raises(StateError, match="term must hold a number, found 'newest'"):
            _ = state.term


def test_one_task_set_at_a_time(tmp_path: Path) -> None:
    with (
        StateFolder(tmp_path / "state", tmp_path / "run"),
        pytest.raises(StateError, match="another rce-container"),
        StateFolder(tmp_path / "state", tmp_path / "run"),
    ):
        pass


def test_a_run_folder_that_is_too_long(tmp_path: Path) -> None:
    with (
        pytest.raises(StateError, match="XDG_RUNTIME_DIR"),
        StateFolder(tmp_path / "state", tmp_path / ("x" * 90)),
    ):
        pass


def test_records_and_removal(tmp_path: Path) -> None:
    with StateFolder(tmp_path / "state", tmp_path / "run") as state:
        folder = state.create("user/box")
        assert folder.read_record() is None
        record = Record(
            id="user/box", incarnation_id=folder.incarnation_id, runtime="process", pid=1, start=2
        )
        folder.write_record(record)
        (found,) = state.existing()
        assert found.read_record() == record
        outside = tmp_path / "outside"
        outside.mkdir()
        (outside / "file").touch()
        locked = folder.home / "locked"
        locked.mkdir()
        (locked / "file").touch()
        (locked / "link").symlink_to(outside)
        locked.chmod(0)
        found.remove()
        assert list(state.existing()) == []
        assert (outside / "file").exists()
    assert not list((tmp_path / "run").iterdir())
