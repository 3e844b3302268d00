"""The demo's folder: removed at the end, and by the next demo if its owner was killed."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from rce_fleet.demo.resources import LOCK, PREFIX, remove_abandoned, run_folder

if TYPE_CHECKING:
    from pathlib import Path

OWNER = """
import os, sys
from pathlib import Path
from rce_fleet.demo.resources import run_folder
with run_folder() as folder:
    (folder / "data").write_text("x")
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path


def test_a_folder_is_removed_at_the_end(tmp: Path) -> None:
    with run_folder() as folder:
        assert folder.parent == tmp
        (folder / "state").mkdir()
    assert list(tmp.iterdir()) == []


def test_a_folder_to_be_kept_is_kept(tmp: Path) -> None:
    with run_folder(tmp / "kept") as folder:
        pass
    assert folder.is_dir()
    assert folder.parent == tmp / "kept"


def test_folder_of_a_killed_demo_is_removed_by_the_next(tmp: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OWNER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as owner:
        assert owner.stdout is not None
        left = owner.stdout.readline().strip()
        assert remove_abandoned(tmp) == [], "its owner lives"
        owner.kill()
    with run_folder():
        assert not os.path.lexists(left)


def test_a_folder_that_a_program_still_uses_stays(tmp: Path) -> None:
    folder = tmp / f"{PREFIX}used"
    folder.mkdir()
    (folder / LOCK).touch()
    with subprocess.Popen(
        [sys.executable, "-c", "input()", str(folder / "config")], stdin=subprocess.PIPE
    ) as user:
        assert remove_abandoned(tmp) == []
        assert user.stdin is not None
        user.stdin.write(b"\n")
    assert remove_abandoned(tmp) == [folder]


def test_folders_of_other_programs_are_kept(tmp: Path) -> None:
    (tmp / f"{PREFIX}without-lock").mkdir()
    (tmp / f"{PREFIX}file").touch()
    (tmp / "other").mkdir()
    (tmp / "other" / LOCK).touch()
    (tmp / f"{PREFIX}link").symlink_to(tmp / "other")
    assert remove_abandoned(tmp) == []
    assert len(list(tmp.iterdir())) == 4
