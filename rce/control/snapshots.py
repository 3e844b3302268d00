"""Snapshots of volumes: what a manifest says, and how one is sent to the master. Pure.

A *snapshot* is a manifest and the pieces that it names, each a content by its SHA-256. A piece that two
snapshots share is sent and kept once.

A task set sends one over a WebSocket to :data:`UPLOADS` on the control port: :class:`Offer` as text, which
the master answers by :class:`Wanted`; then each wanted content as a binary message, answered by
:class:`Kept`. The control channel then carries ``VolumeSaved``. Contents come back as those of packages do
(:mod:`rce.control_channel.contents`).
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, TypeAlias

import msgspec
from msgspec import Struct

from rce.control.exceptions import SnapshotError

if TYPE_CHECKING:
    from collections.abc import Iterator

UPLOADS = "/snapshots"
"""Path of the WebSocket."""
PIECE = 512 << 10
"""Bytes of each piece of a file but the last."""
MAX_ENTRIES = 100_000
"""Files, folders and links of a volume."""
MAX_MANIFEST = 32 << 20
"""Bytes of a manifest as it is sent."""
MAX_PIECES = MAX_MANIFEST // 34
"""Pieces of all files that a volume is read for, holes included; each takes up to 34 bytes of a manifest."""
HOLE = b""
"""In place of the hash of a piece that holds only zeros."""
_MAX_PATH = 4000
_DIGEST_BYTES = 32
_PERMISSIONS = 0o777


class FileEntry(Struct, frozen=True, kw_only=True, tag="f"):
    """A file."""

    path: bytes
    """Relative to the volume."""
    mode: int
    modified_ns: int
    size: int
    pieces: tuple[bytes, ...]
    """SHA-256 of each :data:`PIECE` bytes, or :data:`HOLE`."""


class FolderEntry(Struct, frozen=True, kw_only=True, tag="d"):
    """A folder; what is in it comes after it."""

    path: bytes
    mode: int
    modified_ns: int


class LinkEntry(Struct, frozen=True, kw_only=True, tag="l"):
    """A symbolic link. Where it leads means nothing to the engine, which follows none."""

    path: bytes
    target: bytes


Entry: TypeAlias = FileEntry | FolderEntry | LinkEntry


class Manifest(Struct, frozen=True, kw_only=True):
    """All that is in a volume."""

    entries: tuple[Entry, ...]

    @property
    def files(self) -> Iterator[FileEntry]:
        """Iterate over the files."""
        return (entry for entry in self.entries if isinstance(entry, FileEntry))

    @property
    def size(self) -> int:
        """Bytes of all files, without holes."""
        return sum(length for file in self.files for _, _, length in pieces_of(file))

    @property
    def contents(self) -> set[str]:
        """The hashes of all pieces, in hex."""
        return {piece.hex() for file in self.files for piece in file.pieces if piece != HOLE}

    def encode(self) -> bytes:
        """Write it.

        Raises:
            SnapshotError: It is too long.
        """
        data = msgspec.msgpack.encode(self)
        if len(data) > MAX_MANIFEST:
            raise SnapshotError(
                f"it has too many files: their list would take more than {MAX_MANIFEST >> 20} MB"
            )
        return data


def pieces_of(file: FileEntry) -> Iterator[tuple[bytes, int, int]]:
    """Iterate over the pieces of a file that are no holes: hash, offset, and length in bytes."""
    for number, digest in enumerate(file.pieces):
        if digest != HOLE:
            offset = number * PIECE
            yield digest, offset, min(PIECE, file.size - offset)


def decode_manifest(data: bytes) -> Manifest:
    """Read a manifest, and check that its files can be made in a folder and nowhere else.

    Raises:
        SnapshotError: It is not a manifest, or names what may not be made.
    """
    try:
        manifest = msgspec.msgpack.decode(data, type=Manifest)
    except msgspec.MsgspecError as error:
        raise SnapshotError(f"it is not a manifest: {error}") from error
    if len(manifest.entries) > MAX_ENTRIES:
        raise SnapshotError(f"it names more than {MAX_ENTRIES} files")
    seen: set[bytes] = set()
    folders = {b""}
    for entry in manifest.entries:
        _check_path(entry.path, folders)
        if entry.path in seen:
            raise SnapshotError(f"it names {_show(entry.path)} twice")
        seen.add(entry.path)
        if isinstance(entry, FolderEntry):
            folders.add(entry.path)
        if isinstance(entry, FileEntry):
            _check_file(entry)
        if isinstance(entry, LinkEntry) and not (
            0 < len(entry.target) <= _MAX_PATH and b"\0" not in entry.target
        ):
            raise SnapshotError(f"the link {_show(entry.path)} leads nowhere")
    return manifest


def _check_path(path: bytes, folders: set[bytes]) -> None:
    parts = path.split(b"/")
    if len(path) > _MAX_PATH or b"\0" in path or any(part in (b"", b".", b"..") for part in parts):
        raise SnapshotError(f"{_show(path)} may not be made: it must be a path inside the volume")
    if b"/".join(parts[:-1]) not in folders:
        raise SnapshotError(f"{_show(path)} is in no folder of the manifest")


def _check_file(file: FileEntry) -> None:
    if file.size < 0 or len(file.pieces) != -(-file.size // PIECE):
        raise SnapshotError(f"{_show(file.path)} has {len(file.pieces)} pieces, which do not fit its size")
    if any(piece != HOLE and len(piece) != _DIGEST_BYTES for piece in file.pieces):
        raise SnapshotError(f"{_show(file.path)} has a piece with a wrong hash")


def digest(data: bytes) -> bytes:
    """Return the hash of a piece; :data:`HOLE` for one of zeros only."""
    return hashlib.sha256(data).digest() if data.strip(b"\0") else HOLE


def permissions(mode: int) -> int:
    """Return the permissions that a restored file gets: no set-user-ID and sticky bits."""
    return mode & _PERMISSIONS


def _show(path: bytes) -> str:
    return repr(path.decode(errors="backslashreplace"))[:200]


# Sending


class Offer(Struct, frozen=True, kw_only=True):
    """First message of an upload."""

    volume: str
    """``user/name``."""
    contents: list[str]
    """Hashes of the manifest and of all pieces, in hex."""


class Wanted(Struct, frozen=True, kw_only=True):
    """Answer to :class:`Offer`."""

    contents: list[str] = []
    """Those that the master does not have."""
    error: str = ""
    """Why it takes nothing."""


class Kept(Struct, frozen=True, kw_only=True):
    """Answer to a content: it is on the master's disk, unless there is an error."""

    error: str = ""
