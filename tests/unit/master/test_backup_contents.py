"""What a copy of a master's state holds."""

from __future__ import annotations

import tarfile
from typing import TYPE_CHECKING

from rce_master.backup import MASTER, back_up
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
