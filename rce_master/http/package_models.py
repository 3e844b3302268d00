"""What the REST API takes and gives of packages."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from rce_master.http.model import Model


class PackageKeyIn(Model):
    """A public key to trust."""

    model_config = ConfigDict(extra="forbid", strict=True)

    key: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    """Ed25519, in hex."""
    label: Annotated[str, Field(max_length=128)] = ""


class PackageKeyOut(Model):
    """A public key that is trusted."""

    id: str
    key: str
    label: str
    created: float
    """Seconds since 1970."""


class PackageKeysOut(Model):
    """A user's keys."""

    keys: list[PackageKeyOut]


class PackageOut(Model):
    """A version of a package."""

    user: str
    name: str
    version: str
    newest: bool
    """Whether nodes that name no version get this one."""
    description: str
    executables: list[str]
    """What nodes can name as ``exe``."""
    requirements: bool
    """Whether it has a ``requirements.txt``."""
    files: int
    size: int
    """Bytes of all files."""
    packed: int
    """Bytes of the archive."""
    sha256: str
    """Of the archive."""
    digest: str
    """SHA-256 of what the archive unpacks to."""
    key: str
    """Id of the key that signed it."""
    created: float
    """Seconds since 1970."""
    nodes: list[str]
    """Nodes that need it, each ``CONTAINER/NODE``."""
    warnings: list[str] = Field(default=[])
    """What its owner should know; in the answer to a push only."""


class PackagesOut(Model):
    """All versions of all packages."""

    packages: list[PackageOut]
