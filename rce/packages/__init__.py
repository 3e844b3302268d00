"""Packages of nodes that users bring to an engine, as signed archives with a version.

- :mod:`rce.packages.folder` inspects a package's folder and packs it;
- :mod:`rce.packages.archive` reads and writes archives; it trusts nothing that it reads;
- :mod:`rce.packages.contents` inspects an archive; :mod:`rce.packages.unpacking` unpacks it to a disk;
- :mod:`rce.packages.signing` makes keys and signatures; :mod:`rce.model.names` orders versions.
"""

from rce.packages.exceptions import ArchiveError, BadArchiveError, BadKeyError, BadSignatureError
from rce.packages.limits import DEFAULT_LIMITS, ArchiveLimits
from rce.packages.signing import SigningKey, key_id, statement, verify

__all__ = [
    "DEFAULT_LIMITS",
    "ArchiveError",
    "ArchiveLimits",
    "BadArchiveError",
    "BadKeyError",
    "BadSignatureError",
    "SigningKey",
    "key_id",
    "statement",
    "verify",
]
