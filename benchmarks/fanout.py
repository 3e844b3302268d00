"""One publisher, many clients: latency at each client and the load of the robot task set."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from time import perf_counter, time
from typing import Any

from benchmarks.engine import RunningEngine
from benchmarks.figures import spread
from benchmarks.wire import STRING, Robot, robot

SIZE = 256


async def run(running: RunningEngine, *, clients: int, rate: float, seconds: float) -> list[dict[str, Any]]:
    """A robot publishes at ``rate``; ``clients`` other robots receive the messages through the engine."""
    async with contextlib.AsyncExitStack() as stack:
        source = await stack.enter_async_context(robot(running.url, "source"))
        listeners = [
            await stack.enter_async_context(robot(running.url, f"listener{n}")) for n in range(clients)
        ]
        await wire(source, listeners)
        process = running.named("rce_robot")[0]
        latencies: list[float] = []
        for listener in listeners:
            listener.socket.transport.set_protocol(_Ear(latencies))
        cpu, start, sent = sum(process.cpu_times()[:2]), perf_counter(), 0
        while (now := perf_counter() - start) < seconds:
            stamp = struct.pack("<Id", SIZE, time()) + b"x" * (SIZE - 8)
            await source.send_forwarded("out", stamp)
            sent += 1
            await asyncio.sleep(max(0.0, sent / rate - now))
        await asyncio.sleep(0.5)
        cpu = sum(process.cpu_times()[:2]) - cpu
        for listener in listeners:
            listener.socket.transport.set_protocol(listener.socket)
    row = {"clients": clients, "rate Hz": rate, "sent": sent, "received": len(latencies), **spread(latencies)}
    return [row | {"rce-robot cpu %": round(100 * cpu / (perf_counter() - start), 1)}]


async def wire(source: Robot, listeners: list[Robot]) -> None:
    """Connect an interface ``out`` of one robot with an interface ``in`` of each of the others."""

    def interface(client: Robot, tag: str, kind: str) -> dict[str, str]:
        return {"endpointTag": client.name, "interfaceTag": tag, "interfaceType": kind, "className": STRING}

    await source.send(
        "CN",
        {
            "addInterfaces": [
                interface(source, "out", "SubscriberForwarder"),
                *(interface(listener, "in", "PublisherForwarder") for listener in listeners),
            ]
        },
    )
    pairs = [{"tagA": f"{source.name}/out", "tagB": f"{listener.name}/in"} for listener in listeners]
    await source.send("CX", {"connect": pairs})
    await asyncio.gather(*(listener.wait_active("in") for listener in listeners))


class _Ear(asyncio.Protocol):
    """Replaces a client's WebSocket protocol, and only records when messages arrive.

    200 clients of the library in one process would need more time than the engine, and distort the result.
    """

    def __init__(self, latencies: list[float]) -> None:
        self._latencies = latencies
        self._received = b""

    def data_received(self, data: bytes) -> None:
        """Cut unmasked frames of less than 64 kB out of the stream."""
        received = self._received + data
        start = 0
        while len(received) - start >= _SHORT_HEAD:
            opcode, size, head = received[start] & 15, received[start + 1], _SHORT_HEAD
            if size == _LONG_SIZE:
                head = _LONG_HEAD
                size = int.from_bytes(received[start + _SHORT_HEAD : start + head], "big")
            body = start + head
            if len(received) < max(body + size, start + head):
                break
            if opcode == _BINARY:
                self._latencies.append(time() - struct.unpack_from("<d", received, body + 36)[0])
            start = body + size
        self._received = received[start:]


_BINARY, _LONG_SIZE = 2, 126
_SHORT_HEAD, _LONG_HEAD = 2, 4
