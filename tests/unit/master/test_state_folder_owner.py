"""What root does to the state folder of a master that runs as another user."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
import typer

from rce_master.audit import AUDIT, FILE_NAME
from rce_master.cli.backup import backup, restore_
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


@pytest.fixture
async def copy(tmp_path: Path) -> Path:
    """A backup of the state folder ``rce``, which services of another user have."""
    state = tmp_path / "rce"
    (state / "master").mkdir(parents=True)
    (state / "certificates").mkdir(mode=0o700)
    async with open_state(state) as offline:
        command = commands.AddUser(user=User(name="alice", role=UserRole.USER, password="hash", created=0.0))
        await offline.do(command, "add_user", "alice")
    for name in ("engine.pem", "engine.key", "shared.key", "authority.key"):
        (state / "certificates" / name).write_text(name)
        (state / "certificates" / name).chmod(0o600)
    for path in (state / "master", state / "certificates"):
        os.chown(path, SERVICES, SERVICES)
    for name in ("engine.pem", "engine.key"):
        os.chown(state / "certificates" / name, SERVICES, SERVICES)
    os.chown(state / "certificates" / "shared.key", 0, SERVICES)
    (state / "certificates" / "shared.key").chmod(0o640)
    give_to_owner(state / "master")
    file = tmp_path / "copy.tar"
    backup(file, state_dir=state)
    return file


def test_restored_state_is_that_of_its_folders_owner(copy: Path, tmp_path: Path) -> None:
    """Its certificates are for those who had them before: the authority's key stays root's."""
    state = tmp_path / "rce"
    restore_(copy, state_dir=state, replace_=True)
    inside = list((state / "master").rglob("*"))
    assert state / "master" / AUDIT / FILE_NAME in inside
    assert {owner(path) for path in (state / "master", *inside)} == {(SERVICES, SERVICES)}
    certificates = state / "certificates"
    assert {path.name: owner(path) for path in (certificates, *certificates.iterdir())} == {
        "certificates": (SERVICES, SERVICES),
        "engine.pem": (SERVICES, SERVICES),
        "engine.key": (SERVICES, SERVICES),
        "shared.key": (0, SERVICES),
        "authority.key": (0, 0),
    }
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in certificates.iterdir()}
    assert modes == {name: 0o640 if name == "shared.key" else 0o600 for name in modes}


def test_refused_restore_leaves_no_file_of_root(copy: Path, tmp_path: Path) -> None:
    """Such as the lock, which the master could not take then."""
    master = tmp_path / "rce" / "master"
    (master / "lock").unlink()
    with pytest.raises(typer.Exit):
        restore_(copy, state_dir=tmp_path / "rce")
    assert {owner(path) for path in master.rglob("*")} == {(SERVICES, SERVICES)}
