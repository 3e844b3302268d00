"""Unpacks a package to a disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, assert_never

from rce.packages.archive import read_archive
from rce.packages.limits import DEFAULT_LIMITS, ArchiveLimits
from rce.packages.tree import Entry, Kind, Tree

_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_FOLDER, _FILE, _EXECUTABLE = 0o755, 0o444, 0o555


def unpack(file: BinaryIO, into: Path, limits: ArchiveLimits = DEFAULT_LIMITS) -> tuple[Tree, str]:
    """Unpack an archive. Blocks.

    Files are always readable by all users and read-only: the permissions of the folder around them control
    who may reach them.

    Args:
        file: The archive.
        into: An empty folder that no other user can change.
        limits: How large it may be.

    Returns:
        As :func:`rce.packages.archive.read_archive`.

    Raises:
        BadArchiveError: It is not a package's archive. Files that were unpacked until then stay.
        OSError: It cannot be written.
    """

    # The parent folder of an entry was made here and is not a link: Tree checks that.
    def write(entry: Entry, data: Iterator[bytes]) -> None:
        path = into / entry.path
        match entry.kind:
            case Kind.FOLDER:
                path.mkdir(_FOLDER)
                path.chmod(_FOLDER)
            case Kind.LINK:
                path.symlink_to(entry.target)
            case Kind.FILE:
                _write(path, data, _EXECUTABLE if entry.executable else _FILE)
            case _:
                assert_never(entry.kind)

    return read_archive(file, write, limits)


def _write(path: Path, data: Iterator[bytes], mode: int) -> None:
    fd = os.open(path, _CREATE, mode)
    with os.fdopen(fd, "wb") as file:
        for chunk in data:
            file.write(chunk)
        os.fchmod(file.fileno(), mode)
