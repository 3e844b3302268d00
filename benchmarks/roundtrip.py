"""Round trip robot -> container node -> robot, beside a bare websockets echo in the same run."""

from __future__ import annotations

import gc
import json
from collections.abc import Awaitable, Callable
from time import perf_counter
from typing import Any

from websockets.asyncio.client import connect

from benchmarks.engine import RunningEngine, bare_echo
from benchmarks.figures import spread
from benchmarks.wire import ECHO, STRING, Robot, robot, serialized_string, wire_echo

SIZES = (
    *(3, 10, 20, 42, 88, 183, 379, 784, 1623, 3359, 6951, 14384, 29763, 61584),
    *(127427, 263665, 545559, 1128837, 2335721, 4832930, 10000000),
)
BYTES_PER_PASS = 60_000_000
MAX_ROUNDS = 300
MIN_ROUNDS = 5

Trip = Callable[[int], Awaitable[None]]


def rounds_for(size: int) -> int:
    """How often a size is measured in one pass."""
    return max(MIN_ROUNDS, min(MAX_ROUNDS, BYTES_PER_PASS // size))


async def measure(trip: Trip, size: int) -> list[float]:
    """Times of round trips of one size, seconds."""
    await trip(size)
    gc.collect()
    times = []
    for _ in range(rounds_for(size)):
        start = perf_counter()
        await trip(size)
        times.append(perf_counter() - start)
    return times


def forwarder_trip(client: Robot) -> Trip:
    """By topic, serialized messages passed through."""
    payloads = {size: serialized_string(size) for size in SIZES}

    async def trip(size: int) -> None:
        await client.send_forwarded("request", payloads[size])
        frame = await client.receive_binary()
        assert len(frame) == size + 36

    return trip


def converter_trip(client: Robot) -> Trip:
    """By topic, JSON on the robot's side."""
    texts = {size: "x" * size for size in SIZES}

    async def trip(size: int) -> None:
        message = {"iTag": "request", "type": STRING, "msgID": "nil", "msg": {"data": texts[size]}}
        await client.send("DM", message)
        answer = await client.receive_json()
        assert len(answer["msg"]["data"]) == size

    return trip


def service_trip(client: Robot) -> Trip:
    """By service, JSON on the robot's side."""
    texts = {size: "x" * size for size in SIZES}

    async def trip(size: int) -> None:
        message = {"iTag": "service", "type": ECHO, "msgID": "1", "msg": {"data": texts[size]}}
        await client.send("DM", message)
        answer = await client.receive_json()
        assert len(answer["msg"]["data"]) == size

    return trip


async def run(running: RunningEngine, *, passes: int, sizes: tuple[int, ...] = SIZES) -> list[dict[str, Any]]:
    """Measure all paths, pass by pass in turn, so that a drift of the machine meets all of them."""
    times: dict[tuple[str, int], list[float]] = {}
    async with (
        bare_echo() as url,
        connect(url, compression=None, max_size=None) as bare,
        robot(running.url, "forwarding") as forwarding,
        robot(running.url, "converting") as converting,
    ):
        await wire_echo(forwarding, "Forwarder", "benchForwarder")
        await wire_echo(converting, "Converter", "benchConverter")

        async def bare_trip(size: int) -> None:
            await bare.send(b"x" * size)
            await bare.recv()

        trips = {
            "bare websockets echo": bare_trip,
            "forwarder": forwarder_trip(forwarding),
            "converter": converter_trip(converting),
            "service": service_trip(converting),
        }
        for _ in range(passes):
            for size in sizes:
                for name, trip in trips.items():
                    times.setdefault((name, size), []).extend(await measure(trip, size))
        for client in (forwarding, converting):
            for container in ("benchForwarder", "benchConverter"):
                await client.socket.send(json.dumps({"type": "DC", "data": {"containerTag": container}}))
            break
    rows = []
    for (name, size), seconds in sorted(times.items(), key=lambda item: item[0][1]):
        figures = spread(seconds)
        bare_p50 = spread(times["bare websockets echo", size])["p50_ms"]
        rows.append(
            {"path": name, "bytes": size, **figures, "x bare": round(figures["p50_ms"] / bare_p50, 2)}
        )
    return rows
