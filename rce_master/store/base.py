"""The interface of a store.

A store does not know robots or users: it keeps bytes under a table's name and a key. SQLite keeps them on one
machine, etcd on several.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

SCHEMA_VERSION = 2
"""Of what the rows hold. 1: interfaces were stored in their endpoints and connections in their links; these
are converted when they are read (:mod:`rce_master.state.migration`)."""

Snapshot = Mapping[str, Mapping[str, bytes]]
"""The contents of a store: table name to key to encoded record."""


def other_version(store: str, version: object) -> str:
    """Return that another release wrote a store, and what to do."""
    return (
        f"{store} has version {version}, this program reads version {SCHEMA_VERSION}: install the release"
        " that wrote it, or restore a backup made before the upgrade (docs/how-to/backup.md)"
    )


@dataclass(frozen=True, slots=True)
class Row:
    """A record as a store keeps it."""

    table: str
    key: str
    body: bytes | None
    """None: remove it."""


class Store(Protocol):
    """Keeps records over a restart."""

    async def load(self) -> Snapshot:
        """Read everything.

        Raises:
            StoreError: It cannot be read.
        """

    async def begin_term(self, *, above: int = 0) -> int:
        """Take over: begin a new term, and end the term of the former writer.

        Args:
            above: A term of another store, whose rows are copied to this one.

        Returns:
            The term, greater than all before and than that; it survives a crash.

        Raises:
            StoreError: None was begun.
        """

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        """Write rows, all or none; when this returns, they survive a crash.

        Args:
            rows: What to write. Without any, try whether the store can be written; no row changes.
            term: The writer's own, as :meth:`begin_term` returned it; 0 if no term was begun yet.

        Raises:
            StaleTermError: A newer term was begun; nothing was written.
            FencedError: The term has ended, and it may have been written or not.
            StoreError: Nothing was written.
        """

    async def check(self) -> None:
        """Check that it can be used, without writing.

        Raises:
            StoreError: It cannot.
        """

    async def close(self) -> None:
        """Close the store; may be called twice."""
