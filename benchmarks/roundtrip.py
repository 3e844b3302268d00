"""Round trip robot -> container node -> robot, beside a bare websockets echo in the same run."""

from __future__ import annotations

import gc
from collections.abc import Awaitable, Callable
from time import perf_counter
from typing import Any

from websockets.asyncio.client import connect

from benchmarks.engine import Meter, RunningEngine, bare_echo
from benchmarks.figures import percentile, spread
from benchmarks.wire import ECHO, STRING, Robot, robot, serialized_string, wire_echo

SIZES = (
    *(3, 10, 20, 42, 88, 183, 379, 784, 1623, 3359, 6951, 14384, 29763, 61584),
    *(127427, 263665, 545559, 1128837, 2335721, 4832930, 10000000),
)
BYTES_PER_PASS = 60_000_000
MAX_ROUNDS = 300
MIN_ROUNDS = 5
TURNS = 5
"""The number of parts in which the trips of a size are measured in each pass."""

Trip = Callable[[int], Awaitable[None]]
Costs = dict[tuple[str, int], list[dict[str, float]]]
"""Processor time per trip of each kind of process, by path and size; one for each part of the measurement."""


def rounds_for(size: int) -> int:
    """How often a size is measured in one pass."""
    return max(MIN_ROUNDS, min(MAX_ROUNDS, BYTES_PER_PASS // size))


async def measure(trip: Trip, size: int, rounds: int) -> list[float]:
    """Times of round trips of one size, seconds."""
    times = []
    for _ in range(rounds):
        start = perf_counter()
        await trip(size)
        times.append(perf_counter() - start)
    return times


def forwarder_trip(client: Robot) -> Trip:
    """By topic, serialized messages passed through."""
    payloads = {size: serialized_string(size) for size in (20, *SIZES)}

    async def trip(size: int) -> None:
        await client.send_forwarded("request", payloads[size])
        frame = await client.receive_binary()
        assert len(frame) == size + 36

    return trip


def _single_head(frame: bytes) -> int:
    """Bytes before the message in one frame."""
    return 3 + int.from_bytes(frame[1:3], "big")


def single_trip(client: Robot) -> Trip:
    """The same with a message in one frame."""
    payloads = {size: serialized_string(size) for size in (20, *SIZES)}

    async def trip(size: int) -> None:
        await client.send_single("request", payloads[size])
        frame = await client.receive_binary()
        assert len(frame) == size + 4 + _single_head(frame)

    return trip


def converter_trip(client: Robot) -> Trip:
    """By topic, JSON on the robot's side."""
    texts = {size: "x" * size for size in (20, *SIZES)}

    async def trip(size: int) -> None:
        message = {"iTag": "request", "type": STRING, "msgID": "nil", "msg": {"data": texts[size]}}
        await client.send("DM", message)
        answer = await client.receive_json()
        assert len(answer["msg"]["data"]) == size

    return trip


def service_trip(client: Robot) -> Trip:
    """By service, JSON on the robot's side."""
    texts = {size: "x" * size for size in (20, *SIZES)}

    async def trip(size: int) -> None:
        message = {"iTag": "service", "type": ECHO, "msgID": "1", "msg": {"data": texts[size]}}
        await client.send("DM", message)
        answer = await client.receive_json()
        assert len(answer["msg"]["data"]) == size

    return trip


async def run(running: RunningEngine, *, passes: int, sizes: tuple[int, ...] = SIZES) -> list[dict[str, Any]]:
    """Measure all paths in turn, a few trips each, so that a drift of the machine affects all of them."""
    times: dict[tuple[str, int], list[float]] = {}
    costs: Costs = {}
    async with (
        bare_echo() as url,
        connect(url, compression=None, max_size=None) as bare,
        robot(running.url, "forwarding") as forwarding,
        robot(running.url, "single", features="single-frame") as single,
        robot(running.url, "converting") as converting,
    ):
        await wire_echo(forwarding, "Forwarder", "benchForwarder")
        await wire_echo(single, "Forwarder", "benchSingle")
        await wire_echo(converting, "Converter", "benchConverter")

        payloads = {size: b"x" * size for size in sizes}

        async def bare_trip(size: int) -> None:
            await bare.send(payloads[size])
            await bare.recv()

        trips = {
            "bare websockets echo": bare_trip,
            "forwarder": forwarder_trip(forwarding),
            "forwarder, one frame": single_trip(single),
            "converter": converter_trip(converting),
            "service": service_trip(converting),
        }
        meter = Meter(running)
        for _ in range(passes):
            for size in sizes:
                for trip in trips.values():
                    await trip(size)
                gc.collect()
                rounds = max(1, rounds_for(size) // TURNS)
                for name, trip in [*trips.items()] * TURNS:
                    before = meter.read()
                    measured = await measure(trip, size, rounds)
                    times.setdefault((name, size), []).extend(measured)
                    costs.setdefault((name, size), []).append(meter.per_message(before, len(measured)))
        for client, container in (
            (forwarding, "benchForwarder"),
            (single, "benchSingle"),
            (converting, "benchConverter"),
        ):
            await client.send("DC", {"containerTag": container})
    return [_row(key, times, costs) for key in sorted(times, key=lambda key: key[1])]


def _row(key: tuple[str, int], times: dict[tuple[str, int], list[float]], costs: Costs) -> dict[str, Any]:
    name, size = key
    figures = spread(times[key])
    bare = spread(times["bare websockets echo", size])["p50_ms"]
    return {
        "path": name,
        "bytes": size,
        "p10_ms": round(1e3 * percentile(times[key], 0.1), 4),
        **figures,
        "x bare": round(figures["p50_ms"] / bare, 2),
        "engine cpu_ms": _median([sum(cost.values()) for cost in costs[key]]),
        **{part: _median([cost[part] for cost in costs[key]]) for part in costs[key][0]},
    }


def _median(values: list[float]) -> float:
    return round(percentile(values, 0.5), 4)
