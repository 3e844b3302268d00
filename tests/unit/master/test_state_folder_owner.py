"""What root does to the state folder of a master that runs as another user."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rce_master.audit import AUDIT, FILE_NAME
from rce_master.cli.offline import give_to_owner, open_state
from rce_master.state import commands
from rce_master.state.user_records import User, UserRole

pytestmark = pytest.mark.needs("root")

SERVICES = 12345
"""A user and a group."""


def owner(path: Path) -> tuple[int, int]:
    found = path.lstat()
    return found.st_uid, found.st_gid


async def test_root_leaves_an_offline_change_to_the_folders_owner(tmp_path: Path) -> None:
    """Else the master can neither open its store nor write its audit log."""
    folder = tmp_path / "master"
    folder.mkdir()
    os.chown(folder, SERVICES, SERVICES)
    async with open_state(folder) as offline:
        command = commands.AddUser(user=User(name="alice", role=UserRole.USER, password="hash", created=0.0))
        await offline.do(command, "add_user", "alice")
    made = list(folder.rglob("*"))
    assert folder / AUDIT / FILE_NAME in made
    assert {owner(path) for path in made} == {(SERVICES, SERVICES)}


def test_only_what_root_made_changes_its_owner(tmp_path: Path) -> None:
    """No link leads to a file outside, and what other users have stays theirs."""
    outside, folder = tmp_path / "outside", tmp_path / "master"
    outside.write_text("root's")
    folder.mkdir()
    (folder / "of-another").write_text("")
    os.chown(folder / "of-another", 4711, 4711)
    (folder / "link").symlink_to(outside)
    (folder / "hard").hardlink_to(outside)
    (folder / "inner").mkdir()
    (folder / "inner" / "file").write_text("")
    give_to_owner(folder)
    assert owner(folder / "inner" / "file") == (0, 0), "the folder is root's"
    os.chown(folder, SERVICES, SERVICES)
    give_to_owner(folder)
    assert owner(folder / "of-another") == (4711, 4711)
    assert owner(outside) == (0, 0)
    assert {owner(folder / name) for name in ("link", "inner", "inner/file")} == {(SERVICES, SERVICES)}
