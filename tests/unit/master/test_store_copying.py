"""Rows of one store are copied to another one, whole or again."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from rce_master.exceptions import StoreError
from rce_master.state_service import StateService
from rce_master.store import MemoryStore, Row
from rce_master.store.copying import MAX_BYTES, MAX_ROWS, UNFINISHED, batches, copy_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

MANY = 3 * MAX_ROWS


class BreakingStore(MemoryStore):
    """A store that breaks at a save."""

    def __init__(self, saves: int) -> None:
        super().__init__()
        self.left = saves

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        if not self.left:
            raise StoreError("the disk is full")
        self.left -= 1
        await super().save(rows, term)


def snapshot(count: int = MANY) -> dict[str, dict[str, bytes]]:
    return {
        "users": {"anna": b'{"name":"anna"}'},
        "many": {str(number): b"x" * (number % 700) for number in range(count)},
    }


async def test_all_rows_are_copied_and_the_term_grows() -> None:
    target = MemoryStore()
    assert await copy_rows(snapshot(), target, above=41) == MANY + 1
    copied = await target.load()
    assert {table: rows for table, rows in copied.items() if rows} == snapshot()
    assert await target.begin_term() > 42


async def test_a_store_with_a_state_is_left_alone() -> None:
    target = MemoryStore()
    await target.save([Row("users", "berta", b"{}")])
    with pytest.raises(StoreError, match=r"holds a state already \(1 users\)"):
        await copy_rows(snapshot(), target, above=1)
    assert await target.load() == {"users": {"berta": b"{}"}}


@pytest.mark.parametrize("saves", [1, 2, 3])
async def test_an_interrupted_copy_starts_no_master_and_is_repeated(saves: int) -> None:
    target = BreakingStore(saves)
    with pytest.raises(StoreError, match="the disk is full"):
        await copy_rows(snapshot(), target, above=1)
    target.left = 100
    with pytest.raises(StoreError, match="repeat rce master copy"):
        await StateService.open(target, clock=time.monotonic)
    smaller = snapshot(5)
    assert await copy_rows(smaller, target, above=1) == 6
    copied = await target.load()
    assert {table: rows for table, rows in copied.items() if rows} == smaller
    assert not copied.get(UNFINISHED)


async def test_a_target_that_loses_rows_is_noticed() -> None:
    class Losing(MemoryStore):
        async def save(self, rows: Sequence[Row], term: int = 0) -> None:
            await super().save([row for row in rows if row.key != "anna"], term)

    with pytest.raises(StoreError, match="does not return what was written"):
        await copy_rows(snapshot(1), Losing(), above=1)


def test_parts_are_small_in_rows_and_bytes() -> None:
    large = [Row("t", str(number), b"x" * (MAX_BYTES // 3)) for number in range(7)]
    assert [len(part) for part in batches(large)] == [2, 2, 2, 1]
    assert [len(part) for part in batches([Row("t", "a", b"x" * 2 * MAX_BYTES)])] == [1]
    small = [Row("t", str(number), b"") for number in range(MAX_ROWS + 1)]
    assert [len(part) for part in batches(small)] == [MAX_ROWS, 1]
    assert [row for part in batches(small) for row in part] == small
