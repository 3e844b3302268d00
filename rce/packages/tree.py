"""The files of a package, and their rules: the same where it is packed and where it is unpacked."""

from __future__ import annotations

import posixpath
from dataclasses import dataclass
from enum import Enum

from rce.packages.exceptions import BadArchiveError
from rce.packages.limits import DEFAULT_LIMITS, ArchiveLimits

_MAX_PART = 255
_MAX_HOPS = 8


class Kind(Enum):
    """The kind of an entry."""

    FILE = "file"
    FOLDER = "folder"
    LINK = "link"
    """A symbolic link to something inside the package."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A file, a folder or a link of a package."""

    path: str
    """From the package's root, with ``/``; the first part is the package's name."""
    kind: Kind
    size: int = 0
    """Bytes; files only."""
    executable: bool = False
    """Files only."""
    target: str = ""
    """Links only."""

    @property
    def parts(self) -> tuple[str, ...]:
        """The path's parts; their order is the order of the entries."""
        return tuple(self.path.split("/"))


class Tree:
    """All entries of a package, in the order of their paths, folders before their contents."""

    def __init__(self, limits: ArchiveLimits = DEFAULT_LIMITS) -> None:
        self.entries: dict[str, Entry] = {}
        self.size = 0
        """Bytes of all files."""
        self._limits = limits
        self._last: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The only folder at the root: the package's name."""
        return next(iter(self.entries), "")

    @property
    def files(self) -> int:
        """How many files there are."""
        return sum(entry.kind is Kind.FILE for entry in self.entries.values())

    def add(self, entry: Entry) -> None:
        """Take the next entry.

        Raises:
            BadArchiveError: It breaks a rule.
        """
        fault = path_fault(entry.path) or self._place_fault(entry)
        if fault:
            raise BadArchiveError(f"{entry.path!r}: {fault}")
        self.entries[entry.path] = entry
        self._last = entry.parts
        self.size += entry.size
        if len(self.entries) > self._limits.entries:
            raise BadArchiveError(f"it has more than {self._limits.entries} files, folders and links")
        if self.size > self._limits.unpacked:
            raise BadArchiveError(f"its files have more than {self._limits.unpacked} bytes")

    def finish(self) -> None:
        """Check the rules on the whole tree.

        Raises:
            BadArchiveError: It is empty, or a link leads nowhere or out of it.
        """
        if not self.entries:
            raise BadArchiveError("it is empty")
        faults = [
            f"{path!r}: {fault}"
            for path, entry in self.entries.items()
            if entry.kind is Kind.LINK and (fault := self._link_fault(entry))
        ]
        if faults:
            raise BadArchiveError(faults)

    def _place_fault(self, entry: Entry) -> str:
        parts = entry.parts
        if not self.entries and (len(parts) != 1 or entry.kind is not Kind.FOLDER):
            return "the first entry must be the package's folder"
        if self.entries and parts[0] != self.name:
            return f"it is outside of the folder {self.name!r}"
        if parts <= self._last:
            return "it is out of order, or comes twice"
        if len(parts) > self._limits.depth:
            return f"it is more than {self._limits.depth} folders deep"
        parent = self.entries.get("/".join(parts[:-1]))
        if len(parts) > 1 and (parent is None or parent.kind is not Kind.FOLDER):
            return "it is in no folder of the package"
        return ""

    def _link_fault(self, entry: Entry) -> str:
        seen = 0
        while entry.kind is Kind.LINK:
            seen += 1
            found = self._follow(entry)
            if isinstance(found, str):
                return found
            if seen > _MAX_HOPS:
                return "it leads through too many links"
            entry = found
        return ""

    def _follow(self, link: Entry) -> Entry | str:
        """Find the target of a link, step by step: a folder on the way may not be a link itself."""
        if not link.target or posixpath.isabs(link.target):
            return f"it is a link to {link.target!r}; links must be relative and stay in the package"
        at = link.parts[:-1]
        for part in link.target.split("/"):
            here = self.entries.get("/".join(at))
            if here is not None and here.kind is not Kind.FOLDER:
                return f"it is a link through {here.path!r}, which is not a folder"
            if part == "..":
                at = at[:-1]
            elif part not in ("", "."):
                at = (*at, part)
            if not at:
                return f"it is a link to {link.target!r}, out of the package"
        found = self.entries.get("/".join(at))
        if found is None:
            return f"it is a link to {link.target!r}, which is not in the package"
        return found


def path_fault(path: str) -> str:
    """Return the fault of a path; empty for a valid one."""
    for part in path.split("/"):
        if part in ("", ".", ".."):
            return "its path must be plain: no '..', nothing absolute"
        if not part.isprintable():
            return "its name holds characters that cannot be printed"
        if len(part.encode("utf-8", "surrogateescape")) > _MAX_PART:
            return "its name is too long"
    return ""
