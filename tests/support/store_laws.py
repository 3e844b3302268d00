"""What every store does, whatever it keeps its rows in."""

from __future__ import annotations

import pytest

from rce_master.exceptions import StaleTermError
from rce_master.store import Row, Store

ROWS = 1203
"""More than a store reads at a time."""


async def check_round_trip(store: Store) -> None:
    await store.save([Row("users", "a", b"1"), Row("users", "b", b"2"), Row("links", "a", b"3")])
    await store.save([Row("users", "a", None), Row("users", "b", b"4"), Row("users", "none", None)])
    assert await store.load() == {"users": {"b": b"4"}, "links": {"a": b"3"}}


async def check_terms(store: Store) -> int:
    """Check what a term allows; return the last one."""
    await store.save([Row("users", "a", b"1")])
    first = await store.begin_term()
    await store.save([Row("users", "a", b"2")], first)
    second = await store.begin_term()
    assert second > first
    with pytest.raises(StaleTermError, match="another master has taken over"):
        await store.save([Row("users", "a", b"3")], first)
    with pytest.raises(StaleTermError):
        await store.save([], first)
    await store.save([], second)
    await store.save([Row("users", "b", b"4")], second)
    assert await store.load() == {"users": {"a": b"2", "b": b"4"}}
    third = await store.begin_term(above=second + 100)
    assert third > second + 100
    last = await store.begin_term(above=1)
    assert last > third
    return last


async def check_snapshot(store: Store) -> None:
    """Many rows, keys with any characters, values of any bytes."""
    term = await store.begin_term()
    odd = {"anna/rob": b"", "a b/\u00e9\u4e2d": bytes(range(256)), "x" * 200: b"1" * 20_000}
    await store.save([Row("odd", key, body) for key, body in odd.items()], term)
    many = {f"{number:05d}": str(number).encode() for number in range(ROWS)}
    await store.save([Row("many", key, body) for key, body in many.items()], term)
    assert await store.load() == {"odd": odd, "many": many}
    await store.save([Row("odd", key, None) for key in odd if key != "anna/rob"], term)
    assert await store.load() == {"odd": {"anna/rob": b""}, "many": many}
    await store.check()
