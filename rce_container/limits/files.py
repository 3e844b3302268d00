"""Control files of cgroups: read, written, and their folders made and removed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

PROCS = "cgroup.procs"


def write(path: Path, value: int | str) -> None:
    """Write a control file.

    Raises:
        OSError: It does not exist, or the kernel rejects the value; the error names the file.
    """
    fd = os.open(path, os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC)
    try:
        os.write(fd, str(value).encode())
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        os.close(fd)


def read(path: Path) -> str:
    """Read a control file; return an empty text if it does not exist."""
    try:
        return path.read_text()
    except OSError:
        return ""


def number(path: Path) -> int:
    """Read a file with one number; return 0 if it does not exist or contains ``max``."""
    word = read(path).strip()
    return int(word) if word.lstrip("-").isdigit() else 0


def keyed(text: str) -> dict[str, int]:
    """Read lines of a key and a number; leave out other lines."""
    pairs = (line.split() for line in text.splitlines())
    return {pair[0]: int(pair[1]) for pair in pairs if len(pair) == 2 and pair[1].isdecimal()}  # noqa: PLR2004


def tree(folder: Path) -> Iterator[Path]:
    """Return all cgroups from ``folder`` down, children before parents; none if it does not exist."""
    return (Path(path) for path, _, _ in os.walk(folder, topdown=False))


def children(folder: Path) -> list[Path]:
    """Return the cgroups in a cgroup; none if it does not exist."""
    try:
        return [one for one in folder.iterdir() if one.is_dir()]
    except OSError:
        return []


def pids(folder: Path) -> list[int]:
    """Return the processes in a cgroup and below it."""
    return [int(word) for one in tree(folder) for word in read(one / PROCS).split()]


def make(folder: Path) -> None:
    """Make a cgroup, if it does not exist.

    Raises:
        OSError: It cannot be made.
    """
    folder.mkdir(exist_ok=True)


def drop(folder: Path) -> None:
    """Remove a cgroup and those below it; do nothing if it does not exist.

    Raises:
        OSError: It contains a process.
    """
    for one in tree(folder):
        with contextlib.suppress(FileNotFoundError):  # the shim removes it too
            remove(one)


def remove(folder: Path) -> None:
    """Remove a cgroup.

    Raises:
        OSError: It does not exist, or is not empty.
    """
    folder.rmdir()
