"""Manifests of snapshots: what they may name, and nothing outside of the volume."""

from __future__ import annotations

import msgspec
import pytest

from rce.control import SnapshotError
from rce.control.snapshots import (
    HOLE,
    PIECE,
    Entry,
    FileEntry,
    FolderEntry,
    LinkEntry,
    Manifest,
    decode_manifest,
    digest,
    permissions,
    pieces_of,
)

ONE = digest(b"one")


def file(path: bytes, size: int = 3, pieces: tuple[bytes, ...] = (ONE,)) -> FileEntry:
    return FileEntry(path=path, mode=0o644, modified_ns=1, size=size, pieces=pieces)


def folder(path: bytes) -> FolderEntry:
    return FolderEntry(path=path, mode=0o755, modified_ns=1)


def read(*entries: Entry) -> Manifest:
    return decode_manifest(Manifest(entries=entries).encode())


def fault(*entries: Entry) -> str:
    with pytest.raises(SnapshotError) as caught:
        read(*entries)
    return str(caught.value)


def test_a_manifest_is_read_as_it_was_written() -> None:
    odd = b"\xff\xfe name"
    manifest = read(folder(b"a"), file(b"a/b"), LinkEntry(path=b"c", target=b"/etc/passwd"), file(odd))
    assert [entry.path for entry in manifest.entries] == [b"a", b"a/b", b"c", odd]
    assert manifest.contents == {ONE.hex()}
    assert manifest.size == 6


@pytest.mark.parametrize(
    "path",
    [b"", b"/", b"/etc/passwd", b"..", b"../x", b"a/../../x", b"./x", b"a//x", b"a/", b"x\0y", b"x" * 5000],
)
def test_a_path_that_leaves_the_volume_is_refused(path: bytes) -> None:
    assert "may not be made" in fault(folder(b"a"), file(path))


def test_nothing_is_made_through_a_link_or_twice() -> None:
    assert "is in no folder" in fault(LinkEntry(path=b"a", target=b"/etc"), file(b"a/passwd"))
    assert "is in no folder" in fault(file(b"a/b"), folder(b"a"))
    assert "names 'a' twice" in fault(folder(b"a"), LinkEntry(path=b"a", target=b"/etc"))
    assert "leads nowhere" in fault(LinkEntry(path=b"a", target=b""))


def test_pieces_fit_the_size() -> None:
    assert "do not fit its size" in fault(file(b"a", size=PIECE + 1))
    assert "do not fit its size" in fault(file(b"a", size=-1))
    assert "wrong hash" in fault(file(b"a", pieces=(b"short",)))
    holes = file(b"a", size=2 * PIECE + 5, pieces=(HOLE, ONE, ONE))
    assert list(pieces_of(holes)) == [(ONE, PIECE, PIECE), (ONE, 2 * PIECE, 5)]
    assert digest(bytes(100)) == HOLE


@pytest.mark.parametrize("data", [b"", b"{}", b"\x00", msgspec.msgpack.encode({"entries": [{"type": "x"}]})])
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(SnapshotError, match="not a manifest"):
        decode_manifest(data)


def test_special_permissions_are_dropped() -> None:
    assert permissions(0o106755) == 0o755
