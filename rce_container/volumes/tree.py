"""Reads all files of a volume into a manifest, and makes them from one. Follows no links.

A volume is named by a descriptor of its folder. No program may write to it meanwhile. What is neither a file
nor a folder nor a symbolic link (sockets, FIFOs) is left out: it means nothing on another machine. All
functions but :func:`write` block.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import stat
import sys
from collections.abc import Awaitable, Callable, Iterator
from typing import TypeAlias, assert_never

from rce.control import SnapshotError
from rce.control.snapshots import (
    HOLE,
    MAX_ENTRIES,
    MAX_PIECES,
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
from rce.model import about
from rce_container.descent import FOLDER, Descent, names_in
from rce_container.forkserver.kernel import punch_hole, sync_file_system
from rce_container.packages.disk import in_thread

Fetch: TypeAlias = Callable[[str], Awaitable[bytes]]
"""Returns a content by its hash, in hex; raises :class:`SnapshotError`."""

_CLONE = 0x40049409
"""``FICLONE`` (Linux, ``include/uapi/linux/fs.h``): share the blocks of another file."""
_READ = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
_CHANGED = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_OWN = 0o700
_SLACK = 16 << 20
"""Bytes beyond its size that a volume that is a folder may hold for a while."""


class Allowance:
    """Ends the reading of a volume that holds too much, or that is not wanted any more. For one pass.

    A node can make files of any size without data, and any number of links to one file.

    Args:
        size: Bytes that the volume may hold.
        is_wanted: Whether its files are still wanted.
    """

    def __init__(self, size: int, is_wanted: Callable[[], bool] = lambda: True) -> None:
        self._size = size
        self._is_wanted = is_wanted
        self._bytes = 0
        self._pieces = 0

    def begin(self, size: int) -> None:
        """Count a file of this size.

        Raises:
            SnapshotError: The files are too large together, or not wanted any more.
        """
        self._pieces += -(-size // PIECE)
        if self._pieces > MAX_PIECES:
            raise SnapshotError(
                f"its files are larger than {about(MAX_PIECES * PIECE)} together, with their holes"
            )
        self._check_wanted()

    def take(self, count: int) -> None:
        """Count data that is about to be read.

        Raises:
            SnapshotError: It is too much, or not wanted any more.
        """
        self._bytes += count
        if self._bytes > self._size + _SLACK:
            raise SnapshotError(
                f"its files hold more than the {about(self._size)} that it may hold; each hard link counts "
                "as a file, and 512 kB that hold any data count whole"
            )
        self._check_wanted()

    def _check_wanted(self) -> None:
        if not self._is_wanted():
            raise SnapshotError("its container ended while it was read")


class _Access(Descent):
    """Opens files of a volume, also those that a node made unreadable; permissions stay as they are."""

    def __init__(self, root: int) -> None:
        super().__init__(root)
        self._modes: dict[int, int] = {}
        """Former permissions of folders that are open, by descriptor."""

    def open(self, path: bytes) -> int:
        """Open a file to read it; the caller closes it.

        Raises:
            SnapshotError: It is not a file any more.
            OSError: It cannot be opened.
        """
        folder, name = self.parent(path)
        try:
            fd = os.open(name, _READ, dir_fd=folder)
        except PermissionError:
            fd, mode = open_forbidden(folder, name, _READ)
            os.fchmod(fd, mode)
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise SnapshotError(f"the file {os.fsdecode(path)} changed while it was read")
        return fd

    def _enter(self, above: int, name: bytes) -> int:
        found = os.stat(name, dir_fd=above, follow_symlinks=False)
        if found.st_mode & _OWN == _OWN or os.geteuid() == 0:
            try:
                return super()._enter(above, name)
            except PermissionError:
                pass
        fd, mode = open_forbidden(above, name, FOLDER)
        self._modes[fd] = mode
        return fd

    def _leave(self, folder: int) -> None:
        mode = self._modes.pop(folder, None)
        if mode is not None:
            with contextlib.suppress(OSError):
                os.fchmod(folder, mode)
        super()._leave(folder)


def open_forbidden(folder: int, name: bytes, flags: int) -> tuple[int, int]:
    """Allow the owner everything with a file or a folder, and open it.

    Returns:
        Its descriptor, and its former permissions.
    """
    held = os.open(name, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    try:
        found = os.fstat(held).st_mode
        if not (stat.S_ISREG(found) or stat.S_ISDIR(found)):
            raise SnapshotError(f"{os.fsdecode(name)} changed while it was read")
        this, mode = f"/proc/self/fd/{held}", stat.S_IMODE(found)  # what is held, whatever has its name now
        os.chmod(this, mode | _OWN)  # noqa: PTH101 - like its neighbours
        try:
            return os.open(this, flags & ~os.O_NOFOLLOW), mode
        except OSError:
            os.chmod(this, mode)  # noqa: PTH101 - like its neighbours
            raise
    finally:
        os.close(held)


def _walk(access: _Access) -> Iterator[tuple[bytes, os.stat_result]]:
    """Iterate over what is in a volume, each folder before what is in it, always in the same order."""
    waiting = [b""]
    count = 0
    while waiting:
        folder = waiting.pop()
        for name in names_in(access.folder(folder)):
            count += 1
            if count > MAX_ENTRIES:
                raise SnapshotError(f"it has more than {MAX_ENTRIES} files")
            path = folder + b"/" + name if folder else name
            found = access.stat(path)
            yield path, found
            if stat.S_ISDIR(found.st_mode):
                waiting.append(path)


def _leads_to(access: Descent, path: bytes) -> bytes:
    folder, name = access.parent(path)
    return os.readlink(name, dir_fd=folder)


def scan(root: int, allowance: Allowance) -> Manifest:
    """Read a volume.

    Raises:
        SnapshotError: It has too many files or too much data, or changed meanwhile.
        OSError: A file cannot be read.
    """
    entries: list[Entry] = []
    with _Access(root) as access:
        for path, found in _walk(access):
            if stat.S_ISDIR(found.st_mode):
                mode = permissions(found.st_mode)
                entries.append(FolderEntry(path=path, mode=mode, modified_ns=found.st_mtime_ns))
            elif stat.S_ISLNK(found.st_mode):
                entries.append(LinkEntry(path=path, target=_leads_to(access, path)))
            elif stat.S_ISREG(found.st_mode):
                entries.append(_read_file(access, path, found, allowance))
    return Manifest(entries=tuple(entries))


def _read_file(access: _Access, path: bytes, found: os.stat_result, allowance: Allowance) -> FileEntry:
    fd = access.open(path)
    try:
        size = os.fstat(fd).st_size
        allowance.begin(size)
        pieces = [HOLE] * -(-size // PIECE)
        for offset, length in _parts_with_data(fd, size):
            allowance.take(length)
            pieces[offset // PIECE] = digest(_read(fd, offset, length))
    finally:
        os.close(fd)
    return FileEntry(
        path=path,
        mode=permissions(found.st_mode),
        modified_ns=found.st_mtime_ns,
        size=size,
        pieces=tuple(pieces),
    )


def _parts_with_data(fd: int, size: int) -> Iterator[tuple[int, int]]:
    """Iterate over the offsets and lengths of a file's pieces that are not holes as a whole."""
    offset = 0
    while (start := _next_data(fd, offset)) < size:
        offset = start - start % PIECE
        length = min(PIECE, size - offset)
        yield offset, length
        offset += length


def _next_data(fd: int, offset: int) -> int:
    """Return where a file has data, at an offset or after it; beyond any file if nowhere."""
    try:
        return os.lseek(fd, offset, os.SEEK_DATA)
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        return sys.maxsize


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
            fd = access.open(file.path)
            try:
                data = _read(fd, offset, length)
            finally:
                os.close(fd)
        if digest(data).hex() != sha256:
            raise SnapshotError(f"the file {os.fsdecode(file.path)} changed while it was read")
        return data


def copy(root: int, target: int, allowance: Allowance) -> Manifest:
    """Make a folder a copy of a volume, and write only what differs from what the folder holds already.

    Returns:
        What is in the volume, without the hashes of pieces: for :func:`finish_copy`.

    Raises:
        SnapshotError: It has too many files or too much data, or changed meanwhile.
        OSError: It cannot be copied.
    """
    entries: dict[bytes, Entry] = {}
    with _Access(root) as access, Descent(target) as made:
        for path, found in _walk(access):
            mode, modified_ns = permissions(found.st_mode), found.st_mtime_ns
            if stat.S_ISDIR(found.st_mode):
                if not _has(made, path, found):
                    folder, name = made.parent(path)
                    os.mkdir(name, _OWN, dir_fd=folder)
                entries[path] = FolderEntry(path=path, mode=mode, modified_ns=modified_ns)
            elif stat.S_ISLNK(found.st_mode):
                leads = _leads_to(access, path)
                if not _has(made, path, found) or _leads_to(made, path) != leads:
                    _discard(made, path)
                    folder, name = made.parent(path)
                    os.symlink(leads, name, dir_fd=folder)
                entries[path] = LinkEntry(path=path, target=leads)
            elif stat.S_ISREG(found.st_mode):
                _has(made, path, found)
                size = _copy_file(access, path, made, allowance)
                entries[path] = FileEntry(path=path, mode=mode, modified_ns=modified_ns, size=size, pieces=())
    with _Access(target) as access:
        left = [path for path, _ in _walk(access) if path not in entries]
    with Descent(target) as made:
        for path in reversed(left):
            _discard(made, path)
    return Manifest(entries=tuple(entries.values()))


def finish_copy(copied: Manifest, target: int) -> None:
    """Give the files of a copy the permissions and times of what they are copies of."""
    with Descent(target) as made:
        for entry in reversed(copied.entries):
            if not isinstance(entry, LinkEntry):
                _finish_at(made, entry)


def _finish_at(made: Descent, entry: FileEntry | FolderEntry) -> None:
    folder, name = made.parent(entry.path)
    fd = os.open(name, _READ, dir_fd=folder)
    try:
        _finish(fd, entry)
    finally:
        os.close(fd)


def _finish(fd: int, entry: FileEntry | FolderEntry) -> None:
    """Give a file or a folder its permissions and times."""
    os.fchmod(fd, permissions(entry.mode))
    os.utime(fd, ns=(entry.modified_ns, entry.modified_ns))


def _has(made: Descent, path: bytes, found: os.stat_result) -> bool:
    """Whether a copy has something of the same kind at a path; what is of another kind is removed."""
    try:
        there = made.stat(path)
    except FileNotFoundError:
        return False
    if stat.S_IFMT(there.st_mode) == stat.S_IFMT(found.st_mode):
        if not stat.S_ISLNK(there.st_mode):
            folder, name = made.parent(path)
            os.chmod(name, _OWN, dir_fd=folder)
        return True
    _discard(made, path)
    return False


def _discard(made: Descent, path: bytes) -> None:
    """Remove a file, or a folder with what is in it, of a copy."""
    folder, name = made.parent(path)
    try:
        os.unlink(name, dir_fd=folder)
    except FileNotFoundError:
        return
    except IsADirectoryError:
        shutil.rmtree(name, dir_fd=folder)


def _copy_file(access: _Access, path: bytes, made: Descent, allowance: Allowance) -> int:
    """Copy a file; return its size."""
    source = access.open(path)
    try:
        folder, name = made.parent(path)
        fd = os.open(name, _CHANGED, 0o600, dir_fd=folder)
        try:
            found = os.fstat(source)
            size = found.st_size
            allowance.begin(size)
            if os.fstat(fd).st_size > size:  # sharing blocks leaves what is behind them
                os.ftruncate(fd, size)
            try:
                fcntl.ioctl(fd, _CLONE, source)
            except OSError:  # another file system, or one that cannot share blocks
                _copy_data(source, fd, size, allowance)
            else:
                allowance.take(min(size, found.st_blocks * 512))
        finally:
            os.close(fd)
    finally:
        os.close(source)
    return size


def _copy_data(source: int, fd: int, size: int, allowance: Allowance) -> None:
    """Make a file equal to another one, with the same holes."""
    os.ftruncate(fd, size)
    end = 0
    for offset, length in _parts_with_data(source, size):
        _clear(fd, end, offset)
        allowance.take(length)
        data = _read(source, offset, length)
        if os.pread(fd, length, offset) != data:
            _write_all(fd, data, offset)
        end = offset + length
    _clear(fd, end, size)


def _clear(fd: int, start: int, end: int) -> None:
    """Make a part of a file a hole."""
    if _next_data(fd, start) < end:
        punch_hole(fd, start, end - start)


async def write(manifest: Manifest, root: int, fetch: Fetch) -> None:
    """Make the files of a manifest in an empty folder; when this returns, they survive a crash.

    Raises:
        SnapshotError: A content is missing, or is not what its hash says.
        OSError: A file cannot be written.
    """
    with Descent(root) as made:
        for entry in manifest.entries:
            folder, name = made.parent(entry.path)
            match entry:
                case FolderEntry():
                    os.mkdir(name, _OWN, dir_fd=folder)
                case LinkEntry():
                    os.symlink(entry.target, name, dir_fd=folder)
                case FileEntry():
                    fd = os.open(name, _NEW, 0o600, dir_fd=folder)
                    try:
                        await _write_file(entry, fd, fetch)
                    finally:
                        os.close(fd)
                case _:
                    assert_never(entry)
        for entry in reversed(manifest.entries):
            if isinstance(entry, FolderEntry):
                _finish_at(made, entry)
    await in_thread(sync_file_system, root)


async def _write_file(file: FileEntry, fd: int, fetch: Fetch) -> None:
    os.ftruncate(fd, file.size)
    for piece, offset, length in pieces_of(file):
        data = await fetch(piece.hex())
        if len(data) != length or digest(data) != piece:
            raise SnapshotError(f"a piece of {os.fsdecode(file.path)} is not what its hash says")
        await in_thread(_write_all, fd, data, offset)
    _finish(fd, file)


def _write_all(fd: int, data: bytes, offset: int) -> None:
    left = memoryview(data)
    while left:
        count = os.pwrite(fd, left, offset)
        left, offset = left[count:], offset + count
