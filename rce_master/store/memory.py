"""A store that forgets everything with its process: for tests and trials."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.exceptions import StaleTermError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_master.store.base import Row, Snapshot


class MemoryStore:
    """A store in a dict."""

    def __init__(self) -> None:
        self.tables: dict[str, dict[str, bytes]] = {}
        self._term = 0

    async def load(self) -> Snapshot:
        """Read everything."""
        return {name: dict(rows) for name, rows in self.tables.items()}

    async def begin_term(self, *, above: int = 0) -> int:
        """Begin a new term, greater than another one too."""
        self._term = max(self._term, above) + 1
        return self._term

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        """Write rows.

        Raises:
            StaleTermError: A newer term was begun.
        """
        if term < self._term:
            raise StaleTermError(term, self._term)
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
