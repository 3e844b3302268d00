"""Message rate of the path robot -> container node -> robot, 64 B, a fixed number in flight."""

from __future__ import annotations

import asyncio
from time import perf_counter
from typing import Any

from benchmarks.engine import Meter, RunningEngine
from benchmarks.wire import Robot, robot, serialized_string, wire_echo

SIZE = 64
IN_FLIGHT = 32


async def run(running: RunningEngine, *, seconds: float) -> list[dict[str, Any]]:
    """Measure forwarder and converter."""
    rows = []
    for form in ("Forwarder", "Converter"):
        async with robot(running.url, f"rate{form}") as client:
            await wire_echo(client, form, f"box{form}")
            meter = Meter(running)
            before = meter.read()
            rate, returned = await _rate(client, form, seconds)
            costs = meter.per_message(before, returned)
            await client.send("DC", {"containerTag": f"box{form}"})
        row = {"path": form.lower(), "bytes": SIZE, "in flight": IN_FLIGHT, "messages/s": round(rate)}
        rows.append(row | {name: round(cost, 4) for name, cost in costs.items()})
    return rows


async def _rate(client: Robot, form: str, seconds: float) -> tuple[float, int]:
    payload = serialized_string(SIZE)
    message = {"iTag": "request", "type": "std_msgs/String", "msgID": "nil", "msg": {"data": "x" * SIZE}}
    window = asyncio.Semaphore(IN_FLIGHT)
    returned = 0

    async def send() -> None:
        while True:
            await window.acquire()
            if form == "Forwarder":
                await client.send_forwarded("request", payload)
            else:
                await client.send("DM", message)

    sender = asyncio.create_task(send())
    start = perf_counter()
    try:
        while (elapsed := perf_counter() - start) < seconds:
            await (client.receive_binary() if form == "Forwarder" else client.receive_json())
            returned += 1
            window.release()
    finally:
        sender.cancel()
        await asyncio.gather(sender, return_exceptions=True)
    return returned / elapsed, returned
