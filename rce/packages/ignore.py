"""Files that are not packed: a ``.rceignore`` in a package's folder, with a pattern on each line.

``*.bag`` is any file or folder of such a name, ``/data`` one at the top only, ``maps/*.png`` a path from
the top, ``build/`` a folder. Empty lines and lines that begin with ``#`` are skipped.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import NamedTuple

from rce.packages.exceptions import BadArchiveError

FILE_NAME = ".rceignore"
ALWAYS = (".git", ".hg", ".svn", "__pycache__", "*.pyc", FILE_NAME)


class _Pattern(NamedTuple):
    parts: tuple[str, ...]
    anchored: bool
    folders_only: bool

    def matches(self, parts: tuple[str, ...], *, is_folder: bool) -> bool:
        if self.folders_only and not is_folder:
            return False
        if not self.anchored:
            return fnmatchcase(parts[-1], self.parts[0])
        return len(parts) == len(self.parts) and all(map(fnmatchcase, parts, self.parts))


class Ignore:
    """The patterns of a folder."""

    def __init__(self, patterns: list[_Pattern]) -> None:
        self._patterns = patterns

    @classmethod
    def parse(cls, text: str) -> Ignore:
        """Read a ``.rceignore``.

        Raises:
            BadArchiveError: A line is not a valid pattern.
        """
        patterns = [_Pattern((name,), anchored=False, folders_only=False) for name in ALWAYS]
        faults = []
        for number, line in enumerate(text.splitlines(), 1):
            words = line.strip()
            if not words or words.startswith("#"):
                continue
            if words.startswith("!") or "**" in words:
                faults.append(f"{FILE_NAME} line {number}: {words!r}: neither '!' nor '**' is understood")
                continue
            parts = tuple(part for part in words.split("/") if part)
            if parts:
                anchored = "/" in words.rstrip("/")
                patterns.append(_Pattern(parts, anchored, words.endswith("/")))
        if faults:
            raise BadArchiveError(faults)
        return cls(patterns)

    def matches(self, parts: tuple[str, ...], *, is_folder: bool) -> bool:
        """Return whether a path is ignored.

        Args:
            parts: From the package's folder.
            is_folder: Whether it is a folder; the contents of an ignored folder are ignored too.
        """
        return any(pattern.matches(parts, is_folder=is_folder) for pattern in self._patterns)
