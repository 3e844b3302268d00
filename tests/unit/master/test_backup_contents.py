"""What a copy of a master's state holds."""

from __future__ import annotations

import tarfile
from typing import TYPE_CHECKING

import pytest

from rce_master.backup import CERTIFICATES, MASTER, BackupError, back_up
from rce_master.snapshots.service import SNAPSHOTS
from rce_master.store.sqlite import SqliteStore

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
