"""Limits on the size of packages; checked where a package is packed, stored and unpacked."""

from __future__ import annotations

from typing import NamedTuple


class ArchiveLimits(NamedTuple):
    """Limits of one package."""

    archive: int = 256 << 20
    """Bytes, compressed."""
    unpacked: int = 1 << 30
    """Bytes of all files."""
    ratio: int = 200
    """How many times its size an archive may unpack to, once it is beyond :attr:`free`."""
    free: int = 32 << 20
    """Bytes that any archive may unpack to."""
    entries: int = 20_000
    """Files, folders and links."""
    depth: int = 32
    """Folders within each other."""
    manifest: int = 64 << 10
    """Bytes of the manifest, and of ``requirements.txt``."""


DEFAULT_LIMITS = ArchiveLimits()
