"""The cost of ``rce-ros`` on a robot: memory and processor, idle and with a topic to the cloud and back."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from time import perf_counter
from typing import Any

import psutil

from benchmarks.engine import BIN, RunningEngine, free_ports, pss
from rce.config.folders import configs_dir
from rce.ros.node import Node
from rce.ros.types import Message
from rce.supervision.process import Child

RATE_HZ = 100
_PLACES = {"idle": 0, f"{RATE_HZ} Hz each way": RATE_HZ}


async def run(running: RunningEngine, *, seconds: float) -> list[dict[str, Any]]:
    """Measure a bridge of ``configs/test.config``: a container, two topics, two services."""
    rows = []
    async with _bridge(running) as (process, core):
        for load, rate in _PLACES.items():
            start, before = perf_counter(), sum(process.cpu_times()[:2])
            returned = await _work(core, rate, seconds)
            elapsed = perf_counter() - start
            cpu = sum(process.cpu_times()[:2]) - before
            rows.append(
                {
                    "load": load,
                    "messages back/s": round(returned / elapsed, 1),
                    "rce-ros PSS MB": round(pss(process) / 1e6, 1),
                    "rce-ros cpu %": round(100 * cpu / elapsed, 2),
                }
            )
    return rows


@contextlib.asynccontextmanager
async def _bridge(running: RunningEngine) -> AsyncIterator[tuple[psutil.Process, str]]:
    """Run a ROS core and ``rce-ros`` as a robot would; yields the bridge and the core's address."""
    (port,) = free_ports(1)
    uri = f"http://127.0.0.1:{port}/"
    with tempfile.TemporaryDirectory(prefix="rce-bench-") as name:
        config = Path(name) / "robot.config"
        text = (configs_dir() / "test.config").read_text(encoding="utf-8")
        config.write_text(text.replace("http://localhost:9000/", running.url), encoding="utf-8")
        env = {"ROS_MASTER_URI": uri}
        core = await Child.start("core", [str(BIN / "rce"), "core", "--port", str(port), "--no-log"], env=env)
        bridge = await Child.start(
            "bridge", [sys.executable, "-m", "rce_client.ros_bridge", str(config)], env=env
        )
        try:
            await _ready(core, "ready:")
            await _ready(bridge, "rce-ros ready:")
            yield psutil.Process(bridge.pid), uri
        finally:
            await bridge.stop()
            await core.stop()


async def _ready(child: Child, word: str) -> None:
    async for line in child.lines():
        if word in line:
            return
    raise RuntimeError(f"{child.name} ended before it was ready")


async def _work(core: str, rate: int, seconds: float) -> int:
    """Publish for some time; returns how many messages came back."""
    if not rate:
        await asyncio.sleep(seconds)
        return 0
    returned = 0

    def count(_: Message) -> None:
        nonlocal returned
        returned += 1

    async with Node("load", argv=[], master_uri=core) as node:
        await node.subscribe("/stringEchoResp", "std_msgs/String", count)
        publisher = await node.advertise("/stringEchoReq", "std_msgs/String")
        await publisher.wait_for_subscribers(1, timeout=30)
        end, due = perf_counter() + seconds, perf_counter()
        while perf_counter() < end:
            publisher.publish(data="x" * 20)
            due += 1 / rate
            await asyncio.sleep(max(0.0, due - perf_counter()))
    return returned
