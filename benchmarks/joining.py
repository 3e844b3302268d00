"""A fleet joins one container, robot after robot: the cost of each, and whether it grows with the fleet."""

from __future__ import annotations

import contextlib
import re
import subprocess
from time import perf_counter
from typing import Any

import psutil

from benchmarks.engine import RunningEngine
from benchmarks.wire import STRING, Robot, robot

CONTAINER = "planner"
TOPICS = ("pose", "status", "odometry", "goal", "plan", "cancel")
"""Of each robot: the first half goes to the container, the others come from it."""
STEP = 100
PROCESSES = {
    "master": "-m rce_master",
    "robot task set": "-m rce_robot",
    "container task set": "-m rce_container --settings",
    "environment": "rce_container.environment",
}
_BYTES = re.compile(r"bytes_acked:(\d+)|bytes_received:(\d+)")


async def run(running: RunningEngine, *, robots: int) -> list[dict[str, Any]]:
    """Let robots join, with six interfaces and six connections each; one row for every hundred of them."""
    rows: list[dict[str, Any]] = []
    async with contextlib.AsyncExitStack() as stack:
        first = await stack.enter_async_context(robot(running.url, "joiner0"))
        await first.send("CC", {"containerTag": CONTAINER})
        await _join(first, 0)  # which waits for the container
        meter = _Meter(running)
        before, begin = meter.read(), perf_counter()
        for number in range(1, robots + 1):
            client = await stack.enter_async_context(robot(running.url, f"joiner{number}"))
            await _join(client, number)
            if number % STEP:
                continue
            now = meter.read()
            spent = {what: (now[what] - before[what]) / STEP for what in now}
            rows.append({"robots": number, "s": round(perf_counter() - begin, 1), **spent})
            print(f"{number} robots have joined", flush=True)
            before, begin = now, perf_counter()
        await first.send("DC", {"containerTag": CONTAINER})
    return [_readable(row, rows[0]) for row in rows]


def _readable(row: dict[str, Any], first: dict[str, Any]) -> dict[str, Any]:
    shown = {
        "robots": row["robots"],
        "seconds for 100": row["s"],
        "control bytes per robot": round(row["bytes"]),
        "x first hundred (bytes)": round(row["bytes"] / first["bytes"], 2),
    }
    for process in PROCESSES:
        shown[f"{process} cpu_ms per robot"] = round(1e3 * row[process], 2)
    total, was = (sum(one[process] for process in PROCESSES) for one in (row, first))
    return shown | {"x first hundred (CPU)": round(total / was, 2)}


async def _join(client: Robot, number: int) -> None:
    """Connect a robot to the container; return when all its interfaces are in use."""
    interfaces, pairs = [], []
    for index, topic in enumerate(TOPICS):
        kinds = ("Publisher", "Subscriber")
        inside, outside = kinds if index < len(TOPICS) // 2 else reversed(kinds)
        tag = f"Robot{number}_{topic}"
        interfaces += [
            {
                "endpointTag": CONTAINER,
                "interfaceTag": tag,
                "interfaceType": f"{inside}Interface",
                "className": STRING,
                "addr": f"/Robot{number}/{topic}",
            },
            {
                "endpointTag": client.name,
                "interfaceTag": topic,
                "interfaceType": f"{outside}Forwarder",
                "className": STRING,
            },
        ]
        pairs.append({"tagA": f"{client.name}/{topic}", "tagB": f"{CONTAINER}/{tag}"})
    await client.send("CN", {"addInterfaces": interfaces})
    await client.send("CX", {"connect": pairs})
    await client.wait_active(*TOPICS, timeout=120)


class _Meter:
    """Measures the processor time of the engine's processes, and the bytes of its control channels."""

    def __init__(self, running: RunningEngine) -> None:
        self._port = running.control_port
        self._processes = {kind: running.named(needle) for kind, needle in PROCESSES.items()}

    def read(self) -> dict[str, float]:
        """Seconds of processor time by kind of process, and bytes on all control channels, both ways."""
        spent = {kind: sum(map(_cpu, found)) for kind, found in self._processes.items()}
        return spent | {"bytes": float(self._control_bytes())}

    def _control_bytes(self) -> int:
        """Return the kernel's byte counts of the master's ends of the control channels."""
        command = ["ss", "-tinHO", "state", "established", f"( sport = :{self._port} )"]
        told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        return sum(int(sent or received) for sent, received in _BYTES.findall(told))


def _cpu(process: psutil.Process) -> float:
    with contextlib.suppress(psutil.Error):
        times = process.cpu_times()
        return float(times.user + times.system)
    return 0.0
