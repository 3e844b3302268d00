"""Reaches what is in a folder that nodes may change meanwhile, and follows no links.

``O_NOFOLLOW`` protects only the last part of a path. A node may exchange each folder before it for a symbolic
link at any time, and a manager that is root then reads or changes files of the machine. So each folder is
opened by its own name, in the folder above it, and nothing is reached by a path with a slash.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAX_DEPTH = 500
"""How deep folders may be nested: a descriptor is kept for each of those above the present one."""
FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW


class Descent:
    """Opens folders below one. A context manager: closes them at its end. All methods block.

    The folders above the last path stay open, so neighbours are reached at little cost.

    Args:
        root: A descriptor of the topmost folder, which stays the caller's.
    """

    def __init__(self, root: int) -> None:
        self._root = root
        self._names: list[bytes] = []
        self._open: list[int] = []
        """Descriptors of the folders of these names, each in the one before."""
        self._path: bytes | None = b""
        """Of the last of them; None: not known."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close_below(0)

    def folder(self, path: bytes) -> int:
        """Open a folder; its descriptor is valid until the next call.

        Args:
            path: Relative to the root; empty for the root itself.

        Raises:
            OSError: A part of the path is not a folder (any more), or it is too deep.
        """
        if path == self._path:
            return self._last
        names = path.split(b"/") if path else []
        if len(names) > MAX_DEPTH:
            raise OSError(errno.ENAMETOOLONG, f"folders are nested more than {MAX_DEPTH} deep")
        kept = 0
        while kept < min(len(names), len(self._names)) and names[kept] == self._names[kept]:
            kept += 1
        self._close_below(kept)
        for name in names[kept:]:
            self._open.append(self._enter(self._last, name))
            self._names.append(name)
        self._path = path
        return self._last

    def parent(self, path: bytes) -> tuple[int, bytes]:
        """Open the folder that something is in; return its descriptor, and the name there.

        Raises:
            OSError: As :meth:`folder`.
        """
        above, _, name = path.rpartition(b"/")
        return self.folder(above), name

    def stat(self, path: bytes) -> os.stat_result:
        """Return what is at a path now.

        Raises:
            OSError: As :meth:`folder`; or there is nothing.
        """
        folder, name = self.parent(path)
        return os.stat(name, dir_fd=folder, follow_symlinks=False)

    @property
    def _last(self) -> int:
        return self._open[-1] if self._open else self._root

    def _close_below(self, kept: int) -> None:
        self._path = None
        while len(self._open) > kept:
            self._names.pop()
            self._leave(self._open.pop())

    def _enter(self, above: int, name: bytes) -> int:
        """Open a folder in another one."""
        return os.open(name, FOLDER, dir_fd=above)

    def _leave(self, folder: int) -> None:
        """Close a folder that :meth:`_enter` opened."""
        os.close(folder)


def names_in(folder: int) -> list[bytes]:
    """Return the names of what is in a folder, in order."""
    with os.scandir(folder) as entries:
        return sorted(os.fsencode(entry.name) for entry in entries)


def stats_below(folder: Path) -> Iterator[os.stat_result]:
    """Iterate over all that is below a folder, as far as it can be read. Blocks."""
    try:
        root = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return
    try:
        with Descent(root) as descent:
            waiting = [b""]
            while waiting:
                path = waiting.pop()
                with contextlib.suppress(OSError):
                    names = names_in(descent.folder(path))
                    for inner in (path + b"/" + name if path else name for name in names):
                        with contextlib.suppress(OSError):  # it was removed meanwhile
                            found = descent.stat(inner)
                            yield found
                            if stat.S_ISDIR(found.st_mode):
                                waiting.append(inner)
    finally:
        os.close(root)
