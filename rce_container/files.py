"""Files of containers: atomic writes, and measuring and removing what nodes left. All functions block."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import subprocess
from pathlib import Path

from rce_container.descent import stats_below

UNFINISHED = ".new"
"""Suffix of a file that is being written. One that is left is of a process that was killed meanwhile."""


def write_whole(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Write a file atomically, through a file :data:`UNFINISHED` beside it.

    Args:
        path: The file.
        data: All of it.
        durable: Whether it is on the disk when this returns; else it may be empty after a loss of power.

    Raises:
        OSError: It cannot be written; the error names a file. A former version stays.
    """
    temporary = path.with_name(f"{path.name}{UNFINISHED}")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
        if durable:
            sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        error.filename = error.filename or str(path)
        raise


def sync_folder(folder: Path) -> None:
    """Write to the disk which files a folder holds."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def size_of(folder: Path) -> int:
    """Return how many bytes the files in a folder hold; follows no links below it."""
    return sum(found.st_size for found in stats_below(folder) if not stat.S_ISDIR(found.st_mode))


def remove(folder: Path) -> None:
    """Remove a folder with its contents, as far as possible; may be repeated."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except RecursionError:  # rm handles any depth
        rm = shutil.which("rm") or "/bin/rm"
        with contextlib.suppress(OSError):
            subprocess.run([rm, "-rf", "--", folder], check=False, capture_output=True)  # noqa: S603
