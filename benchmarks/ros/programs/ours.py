"""Our side: ``ours.py echo | ping SIZES | talk SECONDS | listen | serve | call SECONDS | beat COUNT | idle``.

The other programs in this folder take the same arguments.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Awaitable, Callable

from rce.ros.node import Node, run
from rce.ros.types import Message

STRING = "std_msgs/String"
SET_BOOL = "std_srvs/SetBool"
IN_FLIGHT = 32


def ready() -> None:
    """Print the name of the measured library."""
    print("ready", flush=True)


async def echo(node: Node) -> None:
    """Send every message back."""
    pong = await node.advertise("pong", STRING, queue_size=10)
    await node.subscribe("ping", STRING, pong.publish)
    ready()
    await node.spin()


async def ping(node: Node, sizes: str) -> None:
    """Send each size repeatedly, one message in flight; print the round trips in seconds."""
    answered = asyncio.Event()
    await node.subscribe("pong", STRING, lambda _: answered.set())
    publisher = await node.advertise("ping", STRING, queue_size=10)
    await publisher.wait_for_subscribers(timeout=20)
    await asyncio.sleep(1)
    found: dict[str, list[float]] = {}
    for size, count in json.loads(sizes):
        text, times = "x" * size, []
        for _ in range(count + 3):
            answered.clear()
            begin = time.perf_counter()
            publisher.publish(data=text)
            await answered.wait()
            times.append(time.perf_counter() - begin)
        found[str(size)] = times[3:]
    print(json.dumps(found), flush=True)


async def talk(node: Node, seconds: str) -> None:
    """Publish as fast as subscribers take it; print messages per second."""
    publisher = await node.advertise("flood", STRING, queue_size=1000)
    await publisher.wait_for_subscribers(timeout=20)
    text, sent, end = "x" * 60, 0, time.perf_counter() + float(seconds)
    while time.perf_counter() < end:
        for _ in range(100):
            publisher.publish(data=text)
        sent += 100
        await asyncio.sleep(0)
    print(json.dumps({"sent": sent, "dropped": publisher.dropped}), flush=True)
    await node.spin()


async def listen(node: Node) -> None:
    """Count messages; print how many arrived from the first to the last, and the seconds between these."""
    first = last = 0.0
    count = 0

    def heard(_: Message) -> None:
        nonlocal first, last, count
        last = time.perf_counter()
        first = first or last
        count += 1

    await node.subscribe("flood", STRING, heard, queue_size=1000)
    ready()
    await node.spin()
    print(json.dumps({"received": count, "seconds": last - first}), flush=True)


async def serve(node: Node) -> None:
    """Answer calls."""
    await node.advertise_service("flip", SET_BOOL, lambda request: {"success": not request.data})
    ready()
    await node.spin()


async def call(node: Node, seconds: str) -> None:
    """Print calls per second: one at a time over kept and over new connections, then many at a time."""
    await node.wait_for_service("flip", timeout=20)
    found = {}
    for kind in (True, False):
        client = node.service_client("flip", SET_BOOL, persistent=kind)
        count, begin = 0, time.perf_counter()
        while time.perf_counter() < begin + float(seconds):
            await client(data=True)
            count += 1
        found["persistent" if kind else "single"] = count / (time.perf_counter() - begin)
    found[f"{IN_FLIGHT} in flight"] = await _rate_in_flight(node, float(seconds))
    print(json.dumps(found), flush=True)


async def _rate_in_flight(node: Node, seconds: float) -> float:
    client = node.service_client("flip", SET_BOOL)
    count, begin = 0, time.perf_counter()

    async def call_again_and_again() -> None:
        nonlocal count
        while time.perf_counter() < begin + seconds:
            await client(data=True)
            count += 1

    await asyncio.gather(*(call_again_and_again() for _ in range(IN_FLIGHT)))
    return count / (time.perf_counter() - begin)


async def beat(node: Node, count: str) -> None:
    """Publish the time of sending at 20 Hz, once all subscribers are there."""
    publisher = await node.advertise("beat", "std_msgs/Float64", queue_size=10)
    await publisher.wait_for_subscribers(int(count), timeout=60)
    ready()
    while await node.sleep(0.05):
        publisher.publish(data=time.monotonic())


async def idle(node: Node) -> None:
    """Do nothing, on a topic in either direction."""
    await node.advertise("idle_out", STRING)
    await node.subscribe("idle_in", STRING, lambda _: None)
    ready()
    await node.spin()


async def main(word: str, *arguments: str) -> None:
    """Run the command of the command line."""
    work: dict[str, Callable[..., Awaitable[None]]] = {
        "echo": echo,
        "ping": ping,
        "talk": talk,
        "listen": listen,
        "serve": serve,
        "call": call,
    }
    work |= {"beat": beat, "idle": idle}
    async with Node(f"ours_{word}", argv=[], signals=True) as node:
        await work[word](node, *arguments)


if __name__ == "__main__":
    run(main(*sys.argv[1:]))
