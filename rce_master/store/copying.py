"""Copies all rows of a store to another one, such as from SQLite to etcd.

While a copy is made its target has the row :data:`UNFINISHED`, so that no master starts on a part of it.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

from rce_master.exceptions import StoreError
from rce_master.store.base import Row

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rce_master.store.base import Snapshot, Store

UNFINISHED = "unfinished_copy"
"""Table that a store has only while it is filled."""
_MARK = "mark"
MAX_ROWS = 1000
MAX_BYTES = 512 * 1024
"""Of the rows of one save: etcd takes requests of 1.5 MiB by default, and rows grow by a third on the way."""


async def copy_rows(snapshot: Snapshot, target: Store, *, above: int) -> int:
    """Copy rows to an empty store, or to one that holds a part of an unfinished copy.

    Args:
        snapshot: The rows.
        target: Where no master runs.
        above: The newest term of the store that they are from; the target's term becomes greater.

    Returns:
        The number of rows.

    Raises:
        StoreError: The target has other rows, cannot be written, or does not return what was written.
    """
    there = await target.load()
    if any(there.values()) and not there.get(UNFINISHED):
        names = ", ".join(f"{len(rows)} {table}" for table, rows in sorted(there.items()) if rows)
        raise StoreError(f"the target holds a state already ({names}); name an empty one")
    term = await target.begin_term(above=above)
    removed = [Row(table, key, None) for table, rows in there.items() for key in rows if table != UNFINISHED]
    added = [Row(table, key, body) for table, rows in snapshot.items() for key, body in rows.items()]
    for batch in chain([[Row(UNFINISHED, _MARK, b"{}")]], batches(removed), batches(added)):
        await target.save(batch, term)
    await target.save([Row(UNFINISHED, _MARK, None)], term)
    written = await target.load()
    if _filled(written) != _filled(snapshot):
        raise StoreError("the target does not return what was written to it; was it changed meanwhile?")
    return len(added)


def check_finished(snapshot: Snapshot) -> None:
    """Check that a store holds a whole state.

    Raises:
        StoreError: A copy into it was interrupted.
    """
    if snapshot.get(UNFINISHED):
        raise StoreError("a copy into this store was not finished: repeat rce master copy, or empty it")


def batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield rows in parts that a store takes in one save; a part has at least one row."""
    batch: list[Row] = []
    size = 0
    for row in rows:
        weight = len(row.key) + len(row.body or b"")
        if batch and (len(batch) == MAX_ROWS or size + weight > MAX_BYTES):
            yield batch
            batch, size = [], 0
        batch.append(row)
        size += weight
    if batch:
        yield batch


def _filled(snapshot: Snapshot) -> dict[str, dict[str, bytes]]:
    return {table: dict(rows) for table, rows in snapshot.items() if rows}
