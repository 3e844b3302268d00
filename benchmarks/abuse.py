"""The effect of a user who abuses the robot endpoint on another robot: a 100 Hz probe, with and without."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import urllib.request
from collections.abc import AsyncIterator
from statistics import median
from time import perf_counter
from typing import Any

from benchmarks import attacks
from benchmarks.engine import RunningEngine, pss
from benchmarks.figures import percentile
from benchmarks.targets import ABUSE_MORE_MS, ABUSE_P99_MS
from benchmarks.wire import STRING, Robot, robot
from rce.supervision.process import Child

RATE_HZ = 100.0
SETTLE_S = 5.0
"""Until the engine has done what came before the probe."""
START_S = 60.0
"""Until an attack has begun."""
ALONE = 3
"""Probes without abuse; a single one's maximum is chance, the median of some is not."""

CONTROL = f"none, {attacks.BUSY}"
"""The control: the effect of other work of the processors alone on the probe."""
BUSY_NICE = (10, 19)
"""Priorities of a process that converts large messages, and of one that attacks."""


async def run(running: RunningEngine, *, seconds: float, only: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Measure the probe alone, beside busy processes, then beside each kind of abuse.

    Raises:
        RuntimeError: An attack ended, or could do nothing.
    """
    await asyncio.to_thread(_add_user, running.url)
    rows = []
    async with robot(running.url, "probe") as probe:
        await _wire(probe)
        await asyncio.sleep(SETTLE_S)
        probes = [await _probe(probe, seconds) for _ in range(ALONE)]
        alone = median(map(max, probes))
        rows.append(_row("none", [time for times in probes for time in times], alone, running, most=alone))
        async with contextlib.AsyncExitStack() as stack:
            for nice in BUSY_NICE:
                await stack.enter_async_context(_attacker(attacks.BUSY, str(nice)))
            rows.append(_row(CONTROL, await _probe(probe, seconds), alone, running))
        for kind in only or attacks.KINDS:
            url = await asyncio.to_thread(_robot_url, running.url)
            async with _attacker(kind, url):
                rows.append(_row(kind, await _probe(probe, seconds), alone, running))
    return rows


@contextlib.asynccontextmanager
async def _attacker(kind: str, target: str) -> AsyncIterator[None]:
    """Run a process of :mod:`benchmarks.attacks`.

    Raises:
        RuntimeError: It ended, or has done nothing while the caller was busy.
    """
    child = await Child.start(kind, [sys.executable, "-m", "benchmarks.attacks", kind, target])
    output: list[str] = []
    begun = asyncio.Event()

    async def read() -> None:
        async for line in child.lines():
            output.append(line)
            if line.startswith(attacks.PROGRESS):
                begun.set()
        begun.set()

    def check(since: int) -> None:
        if reading.done():
            raise RuntimeError(f"the attack {kind!r} ended:\n" + "\n".join(output[-20:]))
        if not any(line.startswith(attacks.PROGRESS) for line in output[since:]):
            raise RuntimeError(f"the attack {kind!r} could do nothing:\n" + "\n".join(output[-20:]))

    reading = asyncio.create_task(read())
    try:
        with contextlib.suppress(TimeoutError):  # the engine may still be busy with the attack before
            await asyncio.wait_for(begun.wait(), START_S)
        check(0)
        await asyncio.sleep(1.0)
        before = len(output)
        yield
        check(before)
    finally:
        await child.stop()
        await reading


def _row(
    kind: str, times: list[float], alone: float, running: RunningEngine, *, most: float = 0.0
) -> dict[str, Any]:
    """Return the figures of a probe.

    Args:
        kind: What was beside it.
        times: Of its round trips, seconds.
        alone: The maximum without abuse, seconds.
        running: The engine.
        most: The maximum, if not that of the times.
    """
    p99, most = 1e3 * percentile(times, 0.99), most or max(times)
    more = 1e3 * (most - alone)
    return {
        "abuse": kind,
        "p50 ms": round(1e3 * percentile(times, 0.5), 2),
        "p99 ms": round(p99, 1),
        "max ms": round(1e3 * most, 1),
        "max, more than none ms": round(more, 1),
        "goal": "met" if p99 <= ABUSE_P99_MS and more <= ABUSE_MORE_MS else "missed",
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
