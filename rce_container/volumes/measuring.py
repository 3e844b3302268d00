"""Measures volumes that are folders, while nodes may change them. Follows no links.

A node must not gain room by hiding files from the measurement. So folders that it made unreadable are opened
too, and a folder that cannot be measured counts as one that holds too much.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from typing import TYPE_CHECKING, NamedTuple

from rce.control import SnapshotError
from rce_container.descent import FOLDER, MAX_DEPTH, Descent
from rce_container.volumes.tree import open_forbidden

if TYPE_CHECKING:
    from pathlib import Path

MAX_ENTRIES = 1_000_000
"""Files and folders in one volume: measuring so many takes a few seconds."""
LEAST_PER_ENTRY = 4096
"""Bytes that each file and folder counts at least: an empty one takes an inode and a name of the disk."""
_BLOCK = 512
_OPEN = stat.S_IRUSR | stat.S_IXUSR
_VANISHED = frozenset({errno.ENOENT, errno.ENOTDIR, errno.ELOOP})
"""A node removed something meanwhile, or put something else in its place."""
_CLOSED = frozenset({errno.EACCES, errno.EPERM})


class Measured(NamedTuple):
    """What a folder holds."""

    used: int
    """Bytes."""
    fault: str = ""
    """Why it holds more, or may hold more, than was counted; empty if all was counted."""


class _Reader(Descent):
    """Opens also folders that a node made unreadable; their permissions stay as they are."""

    def __init__(self, root: int) -> None:
        super().__init__(root)
        self._modes: dict[int, int] = {}
        """Former permissions of folders that are open, by descriptor."""

    def _enter(self, above: int, name: bytes) -> int:
        found = os.stat(name, dir_fd=above, follow_symlinks=False)
        if found.st_mode & _OPEN == _OPEN or os.geteuid() == 0 or not stat.S_ISDIR(found.st_mode):
            with contextlib.suppress(PermissionError):
                return super()._enter(above, name)
        try:
            fd, mode = open_forbidden(above, name, FOLDER)
        except SnapshotError:
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR)) from None
        self._modes[fd] = mode
        return fd

    def _leave(self, folder: int) -> None:
        mode = self._modes.pop(folder, None)
        if mode is not None:
            with contextlib.suppress(OSError):
                # A node may have changed it meanwhile; then that counts.
                if stat.S_IMODE(os.fstat(folder).st_mode) == mode | stat.S_IRWXU:
                    os.fchmod(folder, mode)
        super()._leave(folder)


def measure(folder: Path) -> Measured:
    """Return how much disk the files and folders in a folder take. Blocks.

    Files that are open but have no name any more are not counted.

    Args:
        folder: What it is in belongs to the engine.

    Raises:
        OSError: Its folder does not exist, or the machine's resources are exhausted.
    """
    above = os.open(folder.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with _Reader(above) as reader:
            found = _measure(reader, os.fsencode(folder.name))
            # A node may change permissions just now; its container goes on.
            return found if not found.fault else _measure(reader, os.fsencode(folder.name))
    finally:
        os.close(above)


def _measure(reader: Descent, top: bytes) -> Measured:
    used = count = 0
    path: list[bytes] = []
    waiting = [(0, top)]  # depth and name of folders; the folder above the last one is the end of `path`
    fault = ""
    while waiting:
        depth, last = waiting.pop()
        path[depth:] = [last]
        try:
            at = reader.folder(b"/".join(path))
            with os.scandir(at) as entries:
                for entry in entries:
                    count += 1
                    if count > MAX_ENTRIES:
                        return Measured(used, f"it has more than {MAX_ENTRIES} files and folders")
                    name = os.fsencode(entry.name)
                    found = _stat(at, name)
                    if found is None:
                        continue
                    used += max(LEAST_PER_ENTRY, found.st_blocks * _BLOCK)
                    if stat.S_ISDIR(found.st_mode):
                        waiting.append((depth + 1, name))
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                fault = f"it has folders that are nested more than {MAX_DEPTH} deep"
            elif error.errno in _CLOSED:
                fault = "it has a folder that cannot be read"
            elif error.errno not in _VANISHED:
                raise
    return Measured(used, fault)


def _stat(folder: int, name: bytes) -> os.stat_result | None:
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None  # it was removed meanwhile
