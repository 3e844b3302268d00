"""Finds a package's executables at any depth, as rosrun and roslaunch do.

Of several files of one name the one nearest to the package's folder counts, then the first by the alphabet.
Hidden folders are left out; symbolic links are followed, each folder once, so that loops end.
"""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path
from typing import NamedTuple

from rce.ros.package_tree import Stamp, stamp_of

_log = logging.getLogger(__name__)

MAX_FOLDERS = 20_000
"""How many folders of one package are searched."""

MAX_KNOWN = 256
"""How many results are remembered."""


class _Found(NamedTuple):
    """A result and what it depends on."""

    file: Path
    stamps: dict[str, Stamp | None]
    """Of each folder that was looked into."""


class ExecutableFinder:
    """Searches packages' folders; a result is remembered until a folder that was searched for it changes."""

    def __init__(self) -> None:
        self.searches = 0
        """How often folders were searched."""
        self._known: dict[tuple[str, str], _Found] = {}
        self._lock = threading.Lock()

    def find(self, folder: Path, name: str) -> Path | None:
        """Return an executable file of a name in a folder or below; None if there is none.

        Args:
            folder: Of the package.
            name: Of the file, without folders.
        """
        key = str(folder), name
        with self._lock:
            known = self._known.pop(key, None)
            if known is None or not _is_current(known):
                self.searches += 1
                known = _search(*key)
            if known is None:
                return None
            self._known[key] = known
            if len(self._known) > MAX_KNOWN:
                del self._known[next(iter(self._known))]
            return known.file


def is_executable(file: str | Path) -> bool:
    """Return whether a path is a file that this user may execute."""
    # Not pathlib's method: it raises if a folder may not be entered.
    return os.path.isfile(file) and os.access(file, os.R_OK | os.X_OK)  # noqa: PTH113


def _is_current(found: _Found) -> bool:
    return is_executable(found.file) and all(stamp_of(path) == stamp for path, stamp in found.stamps.items())


def _search(root: str, name: str) -> _Found | None:
    stamps: dict[str, Stamp | None] = {}
    seen: set[tuple[int, int]] = set()
    level = [root]
    while level:
        below: list[str] = []
        for path in level:
            stamp = stamps[path] = stamp_of(path)
            if stamp is None or stamp[:2] in seen:
                continue
            if len(seen) >= MAX_FOLDERS:
                _log.warning("%s holds more than %d folders: the rest is not searched", root, MAX_FOLDERS)
                return None
            seen.add(stamp[:2])
            file = os.path.join(path, name)  # noqa: PTH118 - thousands of times
            if is_executable(file):
                return _Found(Path(file), stamps)
            below += _folders(path)
        level = below
    return None


def _folders(path: str) -> list[str]:
    """Return the folders in a folder by name; none if it may not be read, or has just gone."""
    try:
        with os.scandir(path) as scan:
            return sorted(entry.path for entry in scan if not entry.name.startswith(".") and entry.is_dir())
    except OSError:
        return []
