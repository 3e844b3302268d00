"""Reads all files of a volume into a manifest, and makes them from one. Follows no links.

A volume is named by a descriptor of its folder. No program may write to it meanwhile. What is neither a file
nor a folder nor a symbolic link (sockets, FIFOs) is left out: it means nothing on another machine. All
functions but :func:`write` block.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import shutil
import stat
from collections.abc import Awaitable, Callable, Iterator
from typing import Self, TypeAlias, assert_never

from rce.control import SnapshotError
from rce.control.snapshots import (
    MAX_ENTRIES,
    PIECE,
    Entry,
    FileEntry,
    FolderEntry,
    LinkEntry,
    Manifest,
    digest,
    permissions,
    pieces_of,
)
from rce_container.forkserver.kernel import sync_file_system

Fetch: TypeAlias = Callable[[str], Awaitable[bytes]]
"""Returns a content by its hash, in hex; raises :class:`SnapshotError`."""

_CLONE = 0x40049409
"""``FICLONE`` (Linux, ``include/uapi/linux/fs.h``): share the blocks of another file."""
_READ = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_FOLDER = _READ | os.O_DIRECTORY
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
_CHANGED = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_OWN = 0o700


class _Access:
    """Opens files of a volume, also those that a node made unreadable; permissions stay as they are."""

    def __init__(self, root: int) -> None:
        self._root = root
        self._changed: list[tuple[bytes, int]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for path, mode in reversed(self._changed):
            with contextlib.suppress(OSError):
                os.chmod(path, mode, dir_fd=self._root)

    def open(self, path: bytes, found: os.stat_result, flags: int) -> int:
        """Open a file or a folder; the caller closes it."""
        mode = stat.S_IMODE(found.st_mode)
        if stat.S_ISDIR(found.st_mode) and mode & _OWN != _OWN and os.geteuid() != 0:
            self._change(path, mode)
        try:
            return os.open(path, flags, dir_fd=self._root)
        except PermissionError:
            self._change(path, mode)
            return os.open(path, flags, dir_fd=self._root)

    def _change(self, path: bytes, mode: int) -> None:
        os.chmod(path, mode | _OWN, dir_fd=self._root)
        self._changed.append((path, mode))


def _walk(root: int, access: _Access) -> Iterator[tuple[bytes, os.stat_result]]:
    """Iterate over what is in a volume, each folder before what is in it, always in the same order."""
    waiting: list[tuple[bytes, os.stat_result | None]] = [(b"", None)]
    count = 0
    while waiting:
        folder, found = waiting.pop()
        fd = os.dup(root) if found is None else access.open(folder, found, _FOLDER)
        try:
            with os.scandir(fd) as entries:
                names = sorted(os.fsencode(entry.name) for entry in entries)
        finally:
            os.close(fd)
        prefix = folder + b"/" if folder else b""
        for name in names:
            count += 1
            if count > MAX_ENTRIES:
                raise SnapshotError(f"it has more than {MAX_ENTRIES} files")
            path = prefix + name
            found = os.stat(path, dir_fd=root, follow_symlinks=False)
            yield path, found
            if stat.S_ISDIR(found.st_mode):
                waiting.append((path, found))


def scan(root: int) -> Manifest:
    """Read a volume.

    Raises:
        SnapshotError: It has too many files, or changed meanwhile.
        OSError: A file cannot be read.
    """
    entries: list[Entry] = []
    with _Access(root) as access:
        for path, found in _walk(root, access):
            if stat.S_ISDIR(found.st_mode):
                mode = permissions(found.st_mode)
                entries.append(FolderEntry(path=path, mode=mode, modified_ns=found.st_mtime_ns))
            elif stat.S_ISLNK(found.st_mode):
                entries.append(LinkEntry(path=path, target=os.readlink(path, dir_fd=root)))
            elif stat.S_ISREG(found.st_mode):
                entries.append(_read_file(access, path, found))
    return Manifest(entries=tuple(entries))


def _read_file(access: _Access, path: bytes, found: os.stat_result) -> FileEntry:
    fd = access.open(path, found, _READ)
    try:
        size = os.fstat(fd).st_size
        pieces = tuple(
            digest(_read(fd, offset, min(PIECE, size - offset))) for offset in range(0, size, PIECE)
        )
    finally:
        os.close(fd)
    return FileEntry(
        path=path,
        mode=permissions(found.st_mode),
        modified_ns=found.st_mtime_ns,
        size=size,
        pieces=pieces,
    )


def _read(fd: int, offset: int, length: int) -> bytes:
    data = os.pread(fd, length, offset)
    while len(data) < length:
        more = os.pread(fd, length - len(data), offset + len(data))
        if not more:
            raise SnapshotError("a file became shorter while it was read")
        data += more
    return data


class Pieces:
    """Finds the pieces of a volume by their hash.

    Args:
        root: The volume's folder.
        manifest: What :func:`scan` found there.
    """

    def __init__(self, root: int, manifest: Manifest) -> None:
        self._root = root
        self._places = {
            piece.hex(): (file, offset, length)
            for file in manifest.files
            for piece, offset, length in pieces_of(file)
        }

    def __contains__(self, sha256: str) -> bool:
        return sha256 in self._places

    def read(self, sha256: str) -> bytes:
        """Read a piece. Blocks.

        Raises:
            SnapshotError: Its file changed.
            OSError: It cannot be read.
        """
        file, offset, length = self._places[sha256]
        with _Access(self._root) as access:
            found = os.stat(file.path, dir_fd=self._root, follow_symlinks=False)
            fd = access.open(file.path, found, _READ)
            try:
                data = _read(fd, offset, length)
            finally:
                os.close(fd)
        if digest(data).hex() != sha256:
            raise SnapshotError(f"the file {os.fsdecode(file.path)} changed while it was read")
        return data


def copy(root: int, target: int) -> Manifest:
    """Make a folder a copy of a volume, and write only what differs from what the folder holds already.

    Returns:
        What is in the volume, without the hashes of pieces: for :func:`finish_copy`.

    Raises:
        SnapshotError: It has too many files, or changed meanwhile.
        OSError: It cannot be copied.
    """
    entries: dict[bytes, Entry] = {}
    with _Access(root) as access:
        for path, found in _walk(root, access):
            mode, modified_ns = permissions(found.st_mode), found.st_mtime_ns
            if stat.S_ISDIR(found.st_mode):
                if not _has(target, path, found):
                    os.mkdir(path, _OWN, dir_fd=target)
                entries[path] = FolderEntry(path=path, mode=mode, modified_ns=modified_ns)
            elif stat.S_ISLNK(found.st_mode):
                leads = os.readlink(path, dir_fd=root)
                if not _has(target, path, found) or os.readlink(path, dir_fd=target) != leads:
                    _discard(target, path)
                    os.symlink(leads, path, dir_fd=target)
                entries[path] = LinkEntry(path=path, target=leads)
            elif stat.S_ISREG(found.st_mode):
                _has(target, path, found)
                size = _copy_file(access, path, found, target)
                entries[path] = FileEntry(path=path, mode=mode, modified_ns=modified_ns, size=size, pieces=())
    with _Access(target) as access:
        left = [path for path, _ in _walk(target, access) if path not in entries]
    for path in reversed(left):
        _discard(target, path)
    return Manifest(entries=tuple(entries.values()))


def finish_copy(copied: Manifest, target: int) -> None:
    """Give the files of a copy the permissions and times of what they are copies of."""
    for entry in reversed(copied.entries):
        if not isinstance(entry, LinkEntry):
            os.chmod(entry.path, entry.mode, dir_fd=target)
            os.utime(entry.path, ns=(entry.modified_ns, entry.modified_ns), dir_fd=target)


def _has(target: int, path: bytes, found: os.stat_result) -> bool:
    """Whether a copy has something of the same kind at a path; what is of another kind is removed."""
    try:
        there = os.stat(path, dir_fd=target, follow_symlinks=False)
    except FileNotFoundError:
        return False
    if stat.S_IFMT(there.st_mode) == stat.S_IFMT(found.st_mode):
        if not stat.S_ISLNK(there.st_mode):
            os.chmod(path, _OWN, dir_fd=target)
        return True
    _discard(target, path)
    return False


def _discard(target: int, path: bytes) -> None:
    """Remove a file, or a folder with what is in it, of a copy."""
    try:
        os.unlink(path, dir_fd=target)
    except FileNotFoundError:
        return
    except IsADirectoryError:
        shutil.rmtree(path, dir_fd=target)


def _copy_file(access: _Access, path: bytes, found: os.stat_result, target: int) -> int:
    """Copy a file; return its size."""
    source = access.open(path, found, _READ)
    try:
        fd = os.open(path, _CHANGED, 0o600, dir_fd=target)
        try:
            size = os.fstat(source).st_size
            try:
                fcntl.ioctl(fd, _CLONE, source)
            except OSError:  # another file system, or one that cannot share blocks
                os.ftruncate(fd, size)
                for offset in range(0, size, PIECE):
                    data = _read(source, offset, min(PIECE, size - offset))
                    if os.pread(fd, len(data), offset) != data:
                        _write_all(fd, data, offset)
        finally:
            os.close(fd)
    finally:
        os.close(source)
    return size


async def write(manifest: Manifest, root: int, fetch: Fetch) -> None:
    """Make the files of a manifest in an empty folder; when this returns, they survive a crash.

    Raises:
        SnapshotError: A content is missing, or is not what its hash says.
        OSError: A file cannot be written.
    """
    for entry in manifest.entries:
        match entry:
            case FolderEntry():
                os.mkdir(entry.path, _OWN, dir_fd=root)
            case LinkEntry():
                os.symlink(entry.target, entry.path, dir_fd=root)
            case FileEntry():
                await _write_file(entry, root, fetch)
            case _:
                assert_never(entry)
    for entry in reversed(manifest.entries):
        if isinstance(entry, FolderEntry):
            os.chmod(entry.path, permissions(entry.mode), dir_fd=root)
            os.utime(entry.path, ns=(entry.modified_ns, entry.modified_ns), dir_fd=root)
    await asyncio.to_thread(sync_file_system, root)


async def _write_file(file: FileEntry, root: int, fetch: Fetch) -> None:
    fd = os.open(file.path, _NEW, 0o600, dir_fd=root)
    try:
        os.ftruncate(fd, file.size)
        for piece, offset, length in pieces_of(file):
            data = await fetch(piece.hex())
            if len(data) != length or digest(data) != piece:
                raise SnapshotError(f"a piece of {os.fsdecode(file.path)} is not what its hash says")
            await asyncio.to_thread(_write_all, fd, data, offset)
        os.fchmod(fd, permissions(file.mode))
        os.utime(fd, ns=(file.modified_ns, file.modified_ns))
    finally:
        os.close(fd)


def _write_all(fd: int, data: bytes, offset: int) -> None:
    left = memoryview(data)
    while left:
        count = os.pwrite(fd, left, offset)
        left, offset = left[count:], offset + count
