"""The start time of containers, and the memory of containers and task sets."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter, time
from typing import Any

import psutil

from benchmarks.engine import RunningEngine, pss, words
from benchmarks.figures import spread
from benchmarks.wire import STRING, Robot, robot, serialized_string

ENGINE_KINDS = {
    "rce up": "-m rce.supervision",
    "rce-master": "-m rce_master",
    "rce-robot": "-m rce_robot",
    "rce-container": "-m rce_container --settings",
    "fork server": "-m rce_container.forkserver",
}
"""Names of processes, and the texts in their command lines; of two that match, the later one counts."""
CONTAINER_KINDS = {
    "environment": "rce_container.environment",
    "node fork server": "rce_container.forkserver.nodes",
    "echo node": "stringEcho.py",
    "bwrap": "bwrap",
    "holder": "read -r word",
    "shim": "rce-container-shim",
}
OTHERS = "others"


async def start_times(running: RunningEngine, *, count: int) -> list[dict[str, Any]]:
    """Create -> first message of its node, sent as soon as the interfaces are active."""
    times = []
    async with robot(running.url, "starter") as client:
        for number in range(count):
            start = perf_counter()
            await _create(client, [f"start{number}"])
            await client.wait_active(f"request{number}", f"response{number}")
            await client.send_forwarded(f"request{number}", serialized_string(5))
            await client.receive_binary()
            times.append(perf_counter() - start)
            await client.send("DC", {"containerTag": f"start{number}"})
    return [{"containers": count, "one after another": "create -> first message", **spread(times)}]


async def many(running: RunningEngine, *, count: int) -> list[dict[str, Any]]:
    """Create many at once, until all their nodes have answered; then measure their memory while idle."""
    async with robot(running.url, "crowd") as client:
        start = perf_counter()
        await _create(client, [f"crowd{number}" for number in range(count)])
        await client.wait_active(
            *(f"request{n}" for n in range(count)), *(f"response{n}" for n in range(count)), timeout=300
        )
        for number in range(count):
            await client.send_forwarded(f"request{number}", serialized_string(5))
        for _ in range(count):
            await client.receive_binary()
        elapsed = perf_counter() - start
        weight = _weight_of_each(running, count)
        for number in range(count):
            await client.send("DC", {"containerTag": f"crowd{number}"})
    return [{"containers": count, "all at once": f"{elapsed:.1f} s", **weight}]


async def memory(running: RunningEngine, *, after: float) -> list[dict[str, Any]]:
    """Measure the memory of each process of an idle engine: one robot, one container with an echo node.

    Args:
        running: The engine.
        after: Seconds between its start and the measurement.
    """
    async with robot(running.url, "weigher") as client:
        await _create(client, ["weigh0"])
        await client.wait_active("request0", "response0")
        await client.send_forwarded("request0", serialized_string(5))
        await client.receive_binary()
        started = psutil.Process(running.pid).create_time()
        await asyncio.sleep(max(0.0, started + after - time()))
        rows = await asyncio.to_thread(_weigh, running)
        await client.send("DC", {"containerTag": "weigh0"})
    return rows


def _weigh(running: RunningEngine) -> list[dict[str, Any]]:
    """Proportional set size by kind of process, in MB, and their sum."""
    weights = dict.fromkeys((*ENGINE_KINDS, *CONTAINER_KINDS, OTHERS), 0)
    for process in running.processes():
        weights[_kind(process, ENGINE_KINDS | CONTAINER_KINDS) or OTHERS] += pss(process)
    weights["sum"] = sum(weights.values())
    return [{"process": kind, "PSS MB": round(weight / 1e6, 1)} for kind, weight in weights.items()]


def _weight_of_each(running: RunningEngine, count: int) -> dict[str, float]:
    """Return the average memory of one of ``count`` containers, by kind of process."""
    weights = dict.fromkeys(CONTAINER_KINDS, 0)
    for process in running.processes():
        if kind := _kind(process, CONTAINER_KINDS):
            weights[kind] += pss(process)
    sizes = {f"{kind} PSS MB": round(weight / count / 1e6, 2) for kind, weight in weights.items()}
    idle = sum(weight for kind, weight in weights.items() if kind != "echo node")
    return {**sizes, "idle container PSS MB": round(idle / count / 1e6, 1)}


def _kind(process: psutil.Process, kinds: Mapping[str, str]) -> str:
    """Return the kind of a process; empty for other processes."""
    line = words(process)
    first = Path(line[0]).name if line else ""
    if first == "bwrap":
        return first
    text = " ".join(line) if first.startswith(("python", "sh")) else ""
    return next((kind for kind, needle in reversed(list(kinds.items())) if needle in text), "")


async def _create(client: Robot, containers: list[str]) -> None:
    """Make containers with the echo node; the tags of its topics end in the number of the container."""
    nodes, interfaces, pairs = [], [], []
    for container in containers:
        number = container.lstrip("abcdefghijklmnopqrstuvwxyz")
        nodes.append({"containerTag": container, "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"})
        for tag, inside, outside, address in (
            (f"request{number}", "Publisher", "Subscriber", "/stringEchoReq"),
            (f"response{number}", "Subscriber", "Publisher", "/stringEchoResp"),
        ):
            common = {"interfaceTag": tag, "className": STRING}
            interfaces += [
                {"endpointTag": container, "interfaceType": f"{inside}Interface", "addr": address, **common},
                {"endpointTag": client.name, "interfaceType": f"{outside}Forwarder", **common},
            ]
            pairs.append({"tagA": f"{client.name}/{tag}", "tagB": f"{container}/{tag}"})
        await client.send("CC", {"containerTag": container})
    await client.send("CN", {"addNodes": nodes, "addInterfaces": interfaces})
    await client.send("CX", {"connect": pairs})
