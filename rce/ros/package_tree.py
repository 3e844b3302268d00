"""Search for packages below a folder of the package path, in depth as rospack does.

A folder with a manifest is a package, and folders below it are not searched. Folders that hold a file of
:data:`IGNORE_MARKS` are left out with their subfolders; those with :data:`NO_SUBFOLDERS` end the search
there; hidden folders are left out. Symbolic links are followed, each folder once, so that loops end. Of two
packages of one name the one nearer to the root counts, then the first by the alphabet.

A search is remembered for as long as no folder or manifest that it looked at has changed: a package that is
added or renamed later is found.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_log = logging.getLogger(__name__)

IGNORE_MARKS = ("CATKIN_IGNORE", "AMENT_IGNORE", "COLCON_IGNORE")
"""Files that exclude a folder and its subfolders from the search."""

NO_SUBFOLDERS = "rospack_nosubdirs"
"""File that ends the search below a folder."""

MAX_FOLDERS = 100_000
"""How many folders of one root are searched: enough for any workspace, not for a whole disk."""

SMALL = 256
"""A search of at most this many folders is checked for changes each time."""

CHECK_SHARE = 10
"""A check of a larger search is good for this many times as long as it took: it takes a tenth of the time."""

Stamp = tuple[int, int, int, int]
"""Identifies a version of a folder or file: device, inode, time of the last change, size."""


class _Found(NamedTuple):
    """The result of a search and its dependencies."""

    packages: dict[str, Path]
    stamps: dict[str, Stamp | None]
    """Of each folder and manifest that was looked at; None if it could not be."""


class PackageTree:
    """The packages below one root.

    Args:
        root: The folder; if it is a package itself, it is the only one.
        manifests: Names of files that make a folder a package.
        name_of: Returns the name of the package in a folder.
    """

    def __init__(self, root: Path, manifests: tuple[str, ...], name_of: Callable[[Path], str]) -> None:
        self.root = root
        self.searches = 0
        """How often the folders were searched."""
        self.checks = 0
        """How often they were checked for changes."""
        self._manifests = manifests
        self._name_of = name_of
        self._names: dict[str, tuple[Stamp | None, str]] = {}
        """Names in manifests that were read, by their paths."""
        self._found: _Found | None = None
        self._good_until = 0.0
        self._lock = threading.Lock()

    @property
    def is_slow(self) -> bool:
        """Whether :meth:`packages` may take long now: it searches, or checks many folders for changes."""
        found = self._found
        return found is None or (len(found.stamps) > SMALL and time.monotonic() >= self._good_until)

    def packages(self) -> dict[str, Path]:
        """Return the folders of all packages by their names."""
        with self._lock:
            if self._found is None or not self._is_current(self._found):
                self.searches += 1
                self._found = self._search()
                if len(self._found.stamps) > SMALL:  # how long the search is good for, a check has to say
                    self._is_current(self._found)
            return self._found.packages

    def expire(self) -> None:
        """Have the folders checked at the next call, however long the last check is good for."""
        self._good_until = 0.0

    def _is_current(self, found: _Found) -> bool:
        began = time.monotonic()
        if began < self._good_until:
            return True
        self.checks += 1
        is_current = all(stamp_of(path) == stamp for path, stamp in found.stamps.items())
        if is_current and len(found.stamps) > SMALL:
            now = time.monotonic()
            self._good_until = now + CHECK_SHARE * (now - began)
        return is_current

    def _search(self) -> _Found:
        self._good_until = 0.0
        found = _Found({}, {})
        names: dict[str, tuple[Stamp | None, str]] = {}
        seen: set[tuple[int, int]] = set()
        level = [str(self.root)]
        while level:
            below: list[str] = []
            for path in level:
                stamp = found.stamps[path] = stamp_of(path)
                if stamp is None or stamp[:2] in seen:
                    continue
                if len(seen) >= MAX_FOLDERS:
                    _log.warning(
                        "%s holds more than %d folders: the rest is not searched for packages; put a narrower"
                        " folder on the package path",
                        self.root,
                        MAX_FOLDERS,
                    )
                    level = below = []
                    break
                seen.add(stamp[:2])
                below += self._look_into(path, found, names)
            level = below
        self._names = names
        return found

    def _look_into(self, path: str, found: _Found, names: dict[str, tuple[Stamp | None, str]]) -> list[str]:
        """Take a folder's package, or return its folders."""
        try:
            with os.scandir(path) as scan:
                entries = {entry.name: entry for entry in scan}
        except OSError:  # treated as empty: it may not be read, or was just removed
            return []
        if any(mark in entries for mark in IGNORE_MARKS):
            return []
        for manifest in self._manifests:
            if manifest in entries and _is(entries[manifest], os.DirEntry.is_file):
                file = os.path.join(path, manifest)  # noqa: PTH118 - thousands of times
                stamp = found.stamps[file] = stamp_of(file)
                known = self._names.get(file)
                name = known[1] if known is not None and known[0] == stamp else self._name_of(Path(path))
                names[file] = stamp, name
                found.packages.setdefault(name, Path(path))
                return []
        if NO_SUBFOLDERS in entries:
            return []
        return [entry.path for entry in _folders(entries)]


def _folders(entries: dict[str, os.DirEntry[str]]) -> Iterator[os.DirEntry[str]]:
    for name in sorted(entries):
        if not name.startswith(".") and _is(entries[name], os.DirEntry.is_dir):
            yield entries[name]


def _is(entry: os.DirEntry[str], question: Callable[[os.DirEntry[str]], bool]) -> bool:
    try:
        return question(entry)
    except OSError:  # a link to itself, or into a folder that may not be entered
        return False


def stamp_of(path: str) -> Stamp | None:
    """Return the stamp of a folder or file, which changes with it; None if it does not exist."""
    try:
        found = os.stat(path)  # noqa: PTH116 - thousands of times
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size
