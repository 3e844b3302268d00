"""Keeps the contents that the state names, here and at the other masters, and removes all others.

Contents are archives of users' packages and snapshots of nodes' states.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from typing import TYPE_CHECKING, Final

from rce.aio.tasks import TaskScope

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce_master.packages.contents import ContentStore, Incoming
    from rce_master.packages.copies import ArchiveCopies
    from rce_master.state.changes import Changes
    from rce_master.state.tables import Tables
    from rce_master.state_service import StateService

_log = logging.getLogger(__name__)

CONTENT: Final = "content"
"""The noun of errors about them."""
_PAUSE_S = 0.5
"""Between two looks for contents that are not needed any more: nodes may be saved all the time."""


class ContentKeeper:
    """The contents of this master.

    Args:
        state_service: Knows which contents are needed.
        store: Keeps them.
        copies: Those at other masters, if there may be any.

    Attributes:
        store: Keeps the contents.
    """

    def __init__(
        self, state_service: StateService, store: ContentStore, copies: ArchiveCopies | None = None
    ) -> None:
        self.store = store
        self._copies = copies
        self._needed = _NeededByState(state_service.tables)
        self._coming: Counter[str] = Counter()
        """Contents that the state does not name yet."""
        self._dirty = asyncio.Event()
        names = {table.name for table in (state_service.tables.packages, state_service.tables.saved_states)}

        def note(changes: Changes) -> None:
            if any(table in names for table, _ in changes.written()):
                self._dirty.set()

        state_service.listeners.append(note)

    async def run(self) -> None:
        """Remove contents that are not needed, and keep the other masters' complete, until cancelled.

        Raises:
            FencedError: This master leads no more.
        """
        async with TaskScope() as tasks:
            if self._copies is not None:
                tasks.spawn(self._copies.run(self._needed), name="copies of contents")
            await self._sweep()

    async def read(self, sha256: str, offset: int, count: int) -> tuple[bytes, int] | None:
        """Read a piece of a content; one that only another master has is fetched first.

        Returns:
            The piece and the size of the content; None if it does not exist.

        Raises:
            OSError: It cannot be read, or not yet.
        """
        found = await self.store.read(sha256, offset, count)
        if found is not None or self._copies is None or not self._needed.is_needed(sha256):
            return found
        await self._copies.obtain(sha256)
        return await self.store.read(sha256, offset, count)

    @contextlib.asynccontextmanager
    async def keep(self, incoming: Incoming) -> AsyncIterator[str]:
        """Keep a content here and at a majority of the masters; the block makes the state name it.

        If it does not, the content is removed.

        Yields:
            A warning for its owner; empty if there is none.

        Raises:
            StoreError: It cannot be kept.
        """
        self._coming[incoming.sha256] += 1
        try:
            await self.store.keep(incoming)
            if self._copies is None:
                yield ""
            else:
                async with self._copies.spread(incoming.sha256) as warning:
                    yield warning
        finally:
            self._coming -= Counter((incoming.sha256,))
            self._dirty.set()

    async def _sweep(self) -> None:
        await asyncio.to_thread(self.store.forget_incoming)
        self._dirty.set()
        while True:
            await self._dirty.wait()
            self._dirty.clear()
            try:
                await self._remove_unneeded()
            except OSError as error:
                _log.error("contents that are needed no more stay on the disk: %s", error)
            if self._copies is not None:
                self._copies.look()
            await asyncio.sleep(_PAUSE_S)

    async def _remove_unneeded(self) -> None:
        for sha256 in await asyncio.to_thread(self.store.held):
            # Looked at and set aside in one step: what comes or is needed again meanwhile stays.
            if sha256 not in self._coming and not self._needed.is_needed(sha256):
                await asyncio.to_thread(self.store.set_aside(sha256).unlink, missing_ok=True)


class _NeededByState:
    """The contents that the state names."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    async def look(self) -> None:
        """Nothing has to be read."""

    def hashes(self) -> set[str]:
        """Return the hashes of all of them."""
        return {one.sha256 for one in (*self._tables.packages, *self._tables.saved_states)}

    def is_needed(self, sha256: str) -> bool:
        """Tell whether a content is needed."""
        tables = self._tables
        return bool(tables.packages.count("sha256", sha256) or tables.saved_states.count("sha256", sha256))

    def is_complete(self) -> bool:
        """Tell whether all are known."""
        return True
