"""Packages in requests and answers of the REST API."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from rce_master.http.model import Model, Page


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


class PackageKeysOut(Page):
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
    """Values of ``exe`` for nodes of this package."""
    requirements: bool
    """Whether it has a ``requirements.txt``."""
    files: int
    size: int
    """Bytes of all files."""
    packed: int
    """Bytes of the archive."""
    sha256: str
    """SHA-256 of the archive."""
    digest: str
    """SHA-256 of the unpacked files."""
    key: str
    """Id of the key that signed it."""
    created: float
    """Seconds since 1970."""
    nodes: list[str]
    """Some of the nodes that use it, each ``CONTAINER/NODE``."""
    node_count: int
    """How many nodes use it."""
    warnings: list[str] = Field(default=[])
    """Warnings for its owner; only in the answer to a push."""


class PackagesOut(Page):
    """All versions of all packages."""

    packages: list[PackageOut]
