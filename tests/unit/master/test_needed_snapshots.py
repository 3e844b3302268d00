from __future__ import annotations

from pathlib import Path

import pytest

from rce.control.snapshots import FileEntry, Manifest
from rce_master.packages.contents import ContentStore
from rce_master.snapshots.needed import NeededSnapshots
from rce_master.state.tables import Tables
from rce_master.state.volume_records import UserVolume


def digest(number: int) -> bytes:
    return number.to_bytes(32, "big")


class Volumes:
    """Volumes with snapshots, whose manifests are in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tables = Tables()
        self.needed = NeededSnapshots(self.tables.volumes, ContentStore(folder))

    def put(self, name: str, snapshot: int) -> None:
        volume = UserVolume(user="anna", name=name, size=1, snapshot=digest(snapshot).hex())
        self.tables.volumes.assign(volume.id, volume)

    def write(self, snapshot: int, *pieces: int) -> None:
        file = FileEntry(
            path=b"f",
            mode=0o644,
            modified_ns=0,
            size=len(pieces) << 19,
            pieces=tuple(digest(piece) for piece in pieces),
        )
        (self.folder / digest(snapshot).hex()).write_bytes(Manifest(entries=(file,)).encode())

    def are_needed(self, *contents: int) -> list[bool]:
        return [self.needed.is_needed(digest(content).hex()) for content in contents]


@pytest.fixture
def volumes(tmp_path: Path) -> Volumes:
    return Volumes(tmp_path)


async def test_contents_are_needed_until_the_last_manifest_goes(volumes: Volumes) -> None:
    volumes.write(1, 10, 11)
    volumes.write(2, 11, 12)
    volumes.put("a", 1)
    volumes.put("b", 2)
    await volumes.needed.look()
    await volumes.needed.look()
    assert volumes.needed.hashes() == {digest(number).hex() for number in (1, 2, 10, 11, 12)}
    assert volumes.are_needed(1, 2, 10, 11, 12, 13) == [True] * 5 + [False]
    volumes.put("a", 2)
    await volumes.needed.look()
    assert volumes.are_needed(1, 2, 10, 11, 12) == [False, True, False, True, True]
    volumes.tables.volumes.assign("anna/a", None)
    volumes.tables.volumes.assign("anna/b", None)
    await volumes.needed.look()
    assert volumes.needed.hashes() == set()
    assert volumes.needed.is_complete()


async def test_snapshot_without_its_manifest_is_needed(volumes: Volumes) -> None:
    """The manifest is fetched from another master; until then it is unknown what it names."""
    volumes.put("a", 1)
    await volumes.needed.look()
    assert volumes.needed.hashes() == {digest(1).hex()}
    assert volumes.are_needed(1, 10) == [True, False]
    assert not volumes.needed.is_complete()
    volumes.write(1, 10)
    await volumes.needed.look()
    assert volumes.are_needed(1, 10) == [True, True]
    assert volumes.needed.is_complete()
