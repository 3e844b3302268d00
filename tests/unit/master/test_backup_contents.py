"""What a copy of a master's state holds."""

from __future__ import annotations

import tarfile
from typing import IO, TYPE_CHECKING

import pytest

from rce_master import backup
from rce_master.audit import AUDIT, AuditLog, newest
from rce_master.backup import CERTIFICATES, MASTER, BackupError, back_up, restore
from rce_master.exceptions import StoreError
from rce_master.snapshots.service import SNAPSHOTS
from rce_master.store.sqlite import FILE_NAME, SqliteStore

if TYPE_CHECKING:
    from pathlib import Path


async def test_files_of_users_are_left_out(tmp_path: Path) -> None:
    """Contents of volumes may be many gigabytes, and are removed while a copy is made."""
    folder = tmp_path / "state"
    await (await SqliteStore.open(folder)).close()
    (folder / SNAPSHOTS).mkdir()
    (folder / SNAPSHOTS / ("a" * 64)).write_bytes(b"a part of a volume")
    (folder / "audit.log").write_text("kept")
    back_up({MASTER: folder}, tmp_path / "copy.tar")
    with tarfile.open(tmp_path / "copy.tar") as copy:
        names = copy.getnames()
    assert f"{MASTER}/audit.log" in names
    assert not [name for name in names if SNAPSHOTS in name]


async def test_audit_log_that_rotates_meanwhile_is_copied_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "state"
    await (await SqliteStore.open(folder)).close()
    log = AuditLog(folder / AUDIT, lambda: 1.0)
    for subject in ("first", "second", "third"):
        if subject != "first":
            log._turn()
        log.add("alice", "log_in", subject)
    (folder / AUDIT / "notes.txt").write_text("of an operator")
    add = backup._add

    def add_and_rotate(tar: tarfile.TarFile, name: str, source: IO[bytes], hashes: dict[str, str]) -> int:
        size = add(tar, name, source, hashes)
        if name.endswith("audit.jsonl"):
            log._turn()
        return size

    monkeypatch.setattr(backup, "_add", add_and_rotate)
    back_up({MASTER: folder}, tmp_path / "copy.tar")
    log.close()
    restore(tmp_path / "copy.tar", {MASTER: tmp_path / "restored"})
    kept = tmp_path / "restored" / AUDIT
    assert [one.subject for one in newest(kept)] == ["first", "second", "third"]
    assert (kept / "notes.txt").exists()


async def test_a_member_of_etcd_is_left_out(tmp_path: Path) -> None:
    """Also what ``rce cluster recover`` keeps of its data."""
    folder = tmp_path / "state"
    await (await SqliteStore.open(folder)).close()
    for name in ("etcd", "etcd.before-20261126-200000", "etcd.alone"):
        (folder / name / "member").mkdir(parents=True)
        (folder / name / "member" / "db").write_bytes(b"a large database")
    for name in ("etcd.yaml", "etcd.alone.yaml"):
        (folder / name).write_text("name: m1")
    back_up({MASTER: folder}, tmp_path / "copy.tar")
    with tarfile.open(tmp_path / "copy.tar") as copy:
        assert [name for name in copy.getnames() if "etcd" in name] == []


@pytest.mark.parametrize("part", [MASTER, CERTIFICATES])
async def test_a_copy_is_not_made_where_it_would_be_copied(tmp_path: Path, part: str) -> None:
    """The next copy would hold it, and the one after that both."""
    folders = {MASTER: tmp_path / "state", CERTIFICATES: tmp_path / "certificates"}
    await (await SqliteStore.open(folders[MASTER])).close()
    folders[CERTIFICATES].mkdir()
    out = folders[part] / "copy.tar"
    with pytest.raises(BackupError, match="name a file outside of"):
        back_up(folders, out)
    assert not out.exists()


@pytest.fixture
async def nested(tmp_path: Path) -> dict[str, Path]:
    """Folders with a state, of which ``copy.tar`` is a copy, and a key that was made since."""
    folders = {MASTER: tmp_path / "state", CERTIFICATES: tmp_path / "state" / "certificates"}
    await (await SqliteStore.open(folders[MASTER])).close()
    folders[CERTIFICATES].mkdir()
    key = folders[CERTIFICATES] / "authority.key"
    key.write_text("the copied one")
    back_up(folders, tmp_path / "copy.tar")
    key.write_text("a newer one")
    return folders


def test_certificates_inside_the_state_are_restored(nested: dict[str, Path], tmp_path: Path) -> None:
    _, (aside,) = restore(tmp_path / "copy.tar", nested, replace=True)
    assert (nested[MASTER] / FILE_NAME).exists()
    assert (nested[CERTIFICATES] / "authority.key").read_text() == "the copied one"
    assert (aside / FILE_NAME).exists()
    assert (aside / "certificates" / "authority.key").read_text() == "a newer one"


def test_a_restore_that_fails_tells_where_the_state_is(
    nested: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Path, __: Path) -> None:
        raise OSError("no space")

    monkeypatch.setattr(backup, "_move", fail)
    with pytest.raises(BackupError, match="no space; the former state is in ") as refusal:
        restore(tmp_path / "copy.tar", nested, replace=True)
    (aside,) = tmp_path.glob("state.before-*")
    assert f"{aside}: to use it again" in str(refusal.value)
    assert (aside / FILE_NAME).exists()


@pytest.mark.parametrize("step", ["_move_aside", "_move", "_keep_owners"])
async def test_folder_of_an_interrupted_restore_is_refused(
    nested: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Power is cut before a step: a master that starts then would make a new, empty state."""

    def cut(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(backup, step, cut)
        with pytest.raises(KeyboardInterrupt):
            restore(tmp_path / "copy.tar", nested, replace=True)
    with pytest.raises(StoreError, match=r"did not finish: repeat it .*rce restore FILE --replace"):
        await SqliteStore.open(nested[MASTER])
    if (nested[MASTER] / FILE_NAME).exists():
        with pytest.raises(StoreError, match="did not finish"):
            back_up(nested, tmp_path / "other.tar")
    restore(tmp_path / "copy.tar", nested, replace=True)
    await (await SqliteStore.open(nested[MASTER])).close()
    assert (nested[CERTIFICATES] / "authority.key").read_text() == "the copied one"
