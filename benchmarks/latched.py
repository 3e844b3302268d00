"""Latched messages: how long a late robot waits for one map, and for a burst of many at once."""

from __future__ import annotations

import asyncio
from time import perf_counter
from typing import Any

from benchmarks.engine import RunningEngine, pss
from benchmarks.figures import percentile
from benchmarks.wire import STRING, serialized_string
from rce_client import Connection, Publisher, Serialized

SIZE = 4_000_000
"""Bytes of a map of 2000 x 2000 cells."""
BURST = 50
LONGEST_S = 120.0


async def run(running: RunningEngine, *, passes: int) -> list[dict[str, Any]]:
    """A robot latches maps, each of a separate source; another one connects repeatedly."""
    payload = serialized_string(SIZE)
    rows = []
    async with Connection(running.url, "testUser", "testUser", "mapper") as mapper:
        for count in (1, BURST):
            tag = f"maps{count}"
            source = await mapper.publisher(tag, STRING, raw=True)
            for number in range(count):
                source.publish(payload, latch=f"source{number}")
            found = [await _come_late(running, source, count, f"late{n}") for n in range(passes)]
            await source.close()
            rows.append(
                {
                    "maps": count,
                    "bytes each": SIZE,
                    "received": min(number for _, _, number in found),
                    "first ms": round(1e3 * percentile([first for first, _, _ in found], 0.5), 1),
                    "all ms": round(1e3 * percentile([last for _, last, _ in found], 0.5), 1),
                    "MB/s": round(percentile([number * SIZE / last for _, last, number in found], 0.5) / 1e6),
                    "rce-robot PSS MB": round(sum(map(pss, running.named("rce_robot"))) / 1e6, 1),
                }
            )
    return rows


async def _come_late(
    running: RunningEngine, source: Publisher[Serialized], count: int, name: str
) -> tuple[float, float, int]:
    """Connect a robot, and its interface with the source's.

    Returns:
        Seconds from the request until the first and the last message, and how many came.
    """
    times: list[float] = []
    done = asyncio.Event()

    def take(_: Serialized) -> None:
        times.append(perf_counter())
        if len(times) == count:
            done.set()

    async with Connection(running.url, "testUser", "testUser", name) as late:
        await late.subscriber("in", STRING, take, raw=True)
        began = perf_counter()
        await late.connect(f"mapper/{source.tag}", f"{name}/in")
        try:
            async with asyncio.timeout(LONGEST_S):
                await done.wait()
        except TimeoutError:
            if not times:
                raise
        await late.remove_all()
    return times[0] - began, times[-1] - began, len(times)
