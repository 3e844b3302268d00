"""The effect of a user who abuses the robot endpoint on another robot: a 100 Hz probe, with and without."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import urllib.request
from collections.abc import AsyncIterator
from time import perf_counter
from typing import Any

from benchmarks import attacks
from benchmarks.engine import RunningEngine, pss
from benchmarks.figures import percentile
from benchmarks.targets import ABUSE_P99_MS
from benchmarks.wire import STRING, Robot, robot
from rce.supervision.process import Child

RATE_HZ = 100.0
GOAL_MORE_MS = 100.0

CONTROL = f"none, {attacks.BUSY}"
"""The control: the effect of other work of the processors alone on the probe."""
BUSY_NICE = (10, 19)
"""Priorities of a process that converts large messages, and of one that attacks."""


async def run(running: RunningEngine, *, seconds: float, only: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Measure the probe alone, beside busy processes, then beside each kind of abuse."""
    await asyncio.to_thread(_add_user, running.url)
    rows = []
    async with robot(running.url, "probe") as probe:
        await _wire(probe)
        alone = await _probe(probe, seconds)
        rows.append(_row("none", alone, alone, running))
        async with contextlib.AsyncExitStack() as stack:
            for nice in BUSY_NICE:
                await stack.enter_async_context(_attacker(attacks.BUSY, str(nice)))
            rows.append(_row(CONTROL, await _probe(probe, seconds), alone, running))
        for kind in only or attacks.KINDS:
            url = await asyncio.to_thread(_robot_url, running.url)
            async with _attacker(kind, url):
                await asyncio.sleep(1.0)
                rows.append(_row(kind, await _probe(probe, seconds), alone, running))
    return rows


@contextlib.asynccontextmanager
async def _attacker(kind: str, target: str) -> AsyncIterator[None]:
    """Run a process of :mod:`benchmarks.attacks`."""
    child = await Child.start(kind, [sys.executable, "-m", "benchmarks.attacks", kind, target])
    try:
        async for line in child.lines():
            if line == "ready":
                break
        yield
    finally:
        await child.stop()


def _row(kind: str, times: list[float], alone: list[float], running: RunningEngine) -> dict[str, Any]:
    p99, most = 1e3 * percentile(times, 0.99), 1e3 * max(times)
    more = most - 1e3 * max(alone)
    return {
        "abuse": kind,
        "p50 ms": round(1e3 * percentile(times, 0.5), 2),
        "p99 ms": round(p99, 1),
        "max ms": round(most, 1),
        "goal": "met" if p99 < ABUSE_P99_MS and more < GOAL_MORE_MS else "missed",
        "rce-robot PSS MB": round(sum(map(pss, running.named("rce_robot"))) / 1e6, 1),
    }


async def _wire(probe: Robot) -> None:
    """Join two interfaces of the probe: its messages come back through the endpoint alone."""
    ends = [
        {"endpointTag": "probe", "interfaceTag": tag, "interfaceType": kind, "className": STRING}
        for tag, kind in (("out", "SubscriberConverter"), ("in", "PublisherConverter"))
    ]
    await probe.send("CN", {"addInterfaces": ends})
    await probe.send("CX", {"connect": [{"tagA": "probe/out", "tagB": "probe/in"}]})
    await probe.wait_active("out", "in")


async def _probe(probe: Robot, seconds: float) -> list[float]:
    """Send a small message 100 times a second; return the time of each round trip."""
    count = int(seconds * RATE_HZ)
    sent: list[float] = []
    times: list[float] = []

    async def listen() -> None:
        for number in range(count):
            data = await probe.receive_json()
            assert data["msg"]["data"] == str(number)
            times.append(perf_counter() - sent[number])

    listening = asyncio.create_task(listen())
    start = perf_counter()
    for number in range(count):
        await asyncio.sleep(max(0.0, start + number / RATE_HZ - perf_counter()))
        sent.append(perf_counter())
        await probe.send("DM", {"iTag": "out", "type": STRING, "msgID": "nil", "msg": {"data": str(number)}})
    async with asyncio.timeout(60):
        await listening
    return times


def _request(url: str, body: object, token: str = "") -> dict[str, Any]:
    headers = {"Content-Type": "application/json", **({"Authorization": f"Bearer {token}"} if token else {})}
    request = urllib.request.Request(url, data=json.dumps(body).encode(), headers=headers)
    with urllib.request.urlopen(request, timeout=30) as reply:
        return dict(json.loads(reply.read()))


def _add_user(url: str) -> None:
    """Make the abusing user."""
    token = _request(f"{url}api/v1/login", {"userID": "testUser", "password": "testUser"})["token"]
    _request(f"{url}api/v1/users", {"name": attacks.USER, "password": attacks.PASSWORD}, token)


def _robot_url(url: str) -> str:
    with urllib.request.urlopen(f"{url}?userID={attacks.USER}&version=20130902", timeout=10) as reply:
        return str(json.loads(reply.read())["url"])
