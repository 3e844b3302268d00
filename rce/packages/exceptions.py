"""Errors of packages.

::

    ArchiveError
    +-- BadArchiveError    a folder or an archive cannot be one; each fault is told
    +-- BadSignatureError  it is not what its owner signed
    +-- BadKeyError        a key cannot be read
"""

from __future__ import annotations

from collections.abc import Iterable

_SHOWN = 20


class ArchiveError(Exception):
    """Base of all errors of packages."""


class BadArchiveError(ArchiveError):
    """A folder or an archive cannot be a package.

    Attributes:
        faults: Its faults, each with its place and what to do.
    """

    def __init__(self, faults: str | Iterable[str]) -> None:
        self.faults = (faults,) if isinstance(faults, str) else tuple(faults)
        super().__init__(self.faults)

    def __str__(self) -> str:
        more = len(self.faults) - _SHOWN
        return "; ".join(self.faults[:_SHOWN]) + (f"; and {more} more" if more > 0 else "")


class BadSignatureError(ArchiveError):
    """A package is not what the owner of a key signed."""


class BadKeyError(ArchiveError):
    """A key cannot be read."""
