"""The benchmark of a client that stops reading counts what the others should have got."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from benchmarks import stalled


class Engine:
    def named(self, needle: str) -> list[object]:
        return []


class SlowSource:
    """A robot whose sending is held up as by a full connection; all that it sends arrives."""

    def __init__(self, reading: stalled.Reading) -> None:
        self._reading = reading

    async def send_forwarded(self, tag: str, payload: bytes) -> None:
        await asyncio.sleep(0.25)
        self._reading.received += 1


async def test_a_sender_that_is_held_up_lowers_the_share() -> None:
    reading = stalled.Reading(cast("Any", None))
    source = cast("Any", SlowSource(reading))
    row = await stalled._phase("one stalls", cast("Any", Engine()), source, [reading], 0.5)
    assert row["share %"] <= 100 * 3 / (0.5 * stalled.RATE_HZ)
