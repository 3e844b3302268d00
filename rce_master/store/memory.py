"""A store that forgets everything with its process: for tests and trials."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_master.store.base import Row, Snapshot


class MemoryStore:
    """A store in a dict."""

    def __init__(self) -> None:
        self.tables: dict[str, dict[str, bytes]] = {}

    async def load(self) -> Snapshot:
        """Read everything."""
        return {name: dict(rows) for name, rows in self.tables.items()}

    async def save(self, rows: Sequence[Row]) -> None:
        """Write rows."""
        for row in rows:
            table = self.tables.setdefault(row.table, {})
            if row.body is None:
                table.pop(row.key, None)
            else:
                table[row.key] = row.body

    async def check(self) -> None:
        """It can always be used."""

    async def close(self) -> None:
        """Nothing to let go of."""
