"""A client that stops reading large messages: the effect on other clients and on memory."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from benchmarks.engine import RunningEngine, pss
from benchmarks.fanout import wire
from benchmarks.wire import Robot, robot, serialized_string

SIZE = 5_000_000
RATE_HZ = 15.0
HEALTHY = 2


@dataclass
class Reading:
    """A client that counts received messages."""

    client: Robot
    received: int = 0

    async def run(self) -> None:
        """Read messages until the connection ends."""
        while True:
            await self.client.receive_binary()
            self.received += 1


async def run(running: RunningEngine, *, seconds: float) -> list[dict[str, Any]]:
    """A robot sends 5 MB messages to healthy clients and to one that stops reading after the first phase."""
    async with contextlib.AsyncExitStack() as stack:
        source, *listeners = [
            await stack.enter_async_context(robot(running.url, name))
            for name in ("imageSource", *(f"healthy{n}" for n in range(HEALTHY)), "stalled")
        ]
        await wire(source, listeners)
        healthy = [Reading(client) for client in listeners[:-1]]
        stalled = Reading(listeners[-1])
        tasks = [asyncio.create_task(reading.run()) for reading in (*healthy, stalled)]
        rows = [await _phase("all read", running, source, healthy, seconds)]
        tasks[-1].cancel()
        stalled.client.socket.transport.pause_reading()
        rows.append(await _phase("one stalls", running, source, healthy, seconds))
        rows.append(await _phase("it still stalls", running, source, healthy, seconds))
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        stalled.client.socket.transport.abort()
    return rows


async def _phase(
    name: str, running: RunningEngine, source: Robot, healthy: list[Reading], seconds: float
) -> dict[str, Any]:
    payload = serialized_string(SIZE)
    before = sum(reading.received for reading in healthy)
    start, sent = perf_counter(), 0
    while (now := perf_counter() - start) < seconds:
        await source.send_forwarded("out", payload)
        sent += 1
        await asyncio.sleep(max(0.0, sent / RATE_HZ - now))
    await asyncio.sleep(0.3)
    received = (sum(reading.received for reading in healthy) - before) / len(healthy)
    return {
        "phase": name,
        "bytes": SIZE,
        "sent Hz": round(sent / seconds, 1),
        "healthy client Hz": round(received / seconds, 1),
        "share %": round(100 * received / (RATE_HZ * seconds), 1),
        "rce-robot PSS MB": round(sum(map(pss, running.named("rce_robot"))) / 1e6, 1),
    }
