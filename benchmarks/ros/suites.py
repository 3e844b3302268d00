"""What is measured. Every suite returns rows for a table."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from benchmarks.engine import pss
from benchmarks.figures import percentile, spread
from benchmarks.ros.sides import Side, end, result_of
from benchmarks.roundtrip import SIZES
from rce.ros.errors import RosError
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import Message
from rce.ros.xmlrpc import RpcClient

Rows = list[dict[str, Any]]

BUDGET_BYTES = 40_000_000
"""A size is sent as often as this many bytes allow, within limits."""


def echo(uri: str, sides: list[Side], *, passes: int, quick: bool) -> Rows:
    """Topic echo of std_msgs/String, one message in flight, both ends in one library; sides take turns."""
    sizes = SIZES[::4] if quick else SIZES
    plan = json.dumps([[size, max(8, min(400, BUDGET_BYTES // size))] for size in sizes])
    found: dict[tuple[str, int], list[float]] = {}
    for _ in range(passes):
        for side in sides:
            with side.running(uri, "echo"):
                for size, times in side.result(uri, "ping", plan).items():
                    found.setdefault((side.name, int(size)), []).extend(times)
    reference = {size: percentile(found["rospy", size], 0.5) for size in sizes if ("rospy", size) in found}
    return [
        {
            "path": name,
            "bytes": size,
            "p10_ms": 1e3 * percentile(times, 0.1),
            **spread(times),
            "of rospy": round(percentile(times, 0.5) / reference[size], 2) if size in reference else "",
        }
        for (name, size), times in sorted(found.items(), key=lambda item: (item[0][1], item[0][0]))
    ]


def rate(uri: str, sides: list[Side], *, seconds: float) -> Rows:
    """One publisher that never waits, one subscriber, 60 characters."""
    rows = []
    for side in sides:
        if "talk" not in side.words:
            continue
        with side.running(uri, "listen") as listener:
            talker = side.start(uri, "talk", str(seconds))
            try:
                sent = result_of(talker)["sent"]
                time.sleep(0.5)
            finally:
                end(talker)
            listener.send_signal(signal.SIGINT)
            heard = result_of(listener)
            listener.wait()
        received = heard["received"]
        rows.append(
            {
                "path": side.name,
                "sent/s": round(sent / seconds),
                "received/s": round(received / max(heard["seconds"], 1e-9)),
                "lost %": round(100 * (1 - received / max(1, sent)), 1),
            }
        )
    return rows


async def fanout(uri: str, sides: list[Side], *, subscribers: int, seconds: float) -> Rows:
    """One publisher at 20 Hz, many subscribing nodes of ours in one process: until the last one has it."""
    rows: Rows = []
    for side in sides:
        if "beat" not in side.words:
            continue
        last: dict[float, tuple[int, float]] = {}

        def heard(message: Message, last: dict[float, tuple[int, float]] = last) -> None:
            count, _ = last.get(message.data, (0, 0.0))
            last[message.data] = count + 1, time.monotonic() - message.data

        async with contextlib.AsyncExitStack() as stack:
            process = side.start(uri, "beat", str(subscribers))
            stack.callback(end, process)
            for number in range(subscribers):
                node = Node(f"fan_{number}", argv=[], master_uri=uri, signals=False)
                await stack.enter_async_context(node)
                await node.subscribe("beat", "std_msgs/Float64", heard)
            publisher = psutil.Process(process.pid)
            await asyncio.sleep(2)
            last.clear()
            before = sum(publisher.cpu_times()[:2])
            await asyncio.sleep(seconds)
            used = sum(publisher.cpu_times()[:2]) - before
            delays = [delay for count, delay in last.values() if count == subscribers]
        rows.append(
            {
                "path": side.name,
                "subscribers": subscribers,
                "messages": len(delays),
                **spread(delays),
                "publisher cpu %": round(100 * used / seconds, 1),
            }
        )
    return rows


def services(uri: str, sides: list[Side], *, seconds: float) -> Rows:
    """Calls of std_srvs/SetBool: one after the other, then 32 in flight."""
    rows = []
    for side in sides:
        if "serve" not in side.words:
            continue
        with side.running(uri, "serve"):
            found = side.result(uri, "call", str(seconds))
        rows.append({"path": side.name, **{f"{kind} calls/s": round(value) for kind, value in found.items()}})
    return rows


async def registration(masters: dict[str, str], *, nodes: int) -> Rows:
    """Nodes that come to a core, each with a topic either way and a service; then questions to it.

    The cores take turns, a hundred nodes at a time.
    """
    calls: dict[str, list[float]] = {name: [] for name in masters}
    rows = []
    async with RpcClient() as rpc:
        for first in range(0, nodes, 100):
            for name, uri in masters.items():
                for number in range(first, min(nodes, first + 100)):
                    calls[name] += await _register(rpc, uri, number)
        for name, uri in masters.items():
            asked = [await _timed(rpc, uri, "getSystemState", "/x") for _ in range(10)]
            rows.append(
                {
                    "core": name,
                    "nodes": nodes,
                    "seconds": round(sum(calls[name]), 3),
                    **spread(calls[name]),
                    "getSystemState ms": round(1e3 * percentile(asked, 0.5), 2),
                }
            )
    return rows


async def _register(rpc: RpcClient, uri: str, number: int) -> list[float]:
    caller, slave = f"/n{number}", f"http://127.0.0.1:1/{number}"
    return [
        await _timed(rpc, uri, "registerPublisher", caller, f"/t{number}", "std_msgs/String", slave),
        await _timed(rpc, uri, "registerSubscriber", caller, f"/u{number}", "std_msgs/String", slave),
        await _timed(rpc, uri, "registerService", caller, f"/s{number}", "rosrpc://127.0.0.1:1", slave),
    ]


async def _timed(rpc: RpcClient, uri: str, method: str, *arguments: str) -> float:
    begin = time.perf_counter()
    await rpc.call(uri, method, arguments)
    return time.perf_counter() - begin


async def joining(uri: str, *, nodes: int) -> Rows:
    """Nodes of ours in one process, each with a publisher and a subscriber: time to join, memory."""
    process = psutil.Process()
    before, begin = pss(process), time.perf_counter()
    async with contextlib.AsyncExitStack() as stack:
        for number in range(nodes):
            node = await stack.enter_async_context(
                Node(f"many_{number}", argv=[], master_uri=uri, signals=False)
            )
            await node.advertise(f"many_{number}", "std_msgs/String")
            await node.subscribe(f"none_{number}", "std_msgs/String", lambda _: None)
        took = time.perf_counter() - begin
        used = pss(process) - before
        begin = time.perf_counter()
    left = time.perf_counter() - begin
    return [
        {
            "nodes": nodes,
            "join s": round(took, 2),
            "leave s": round(left, 2),
            "kB per node": round(used / nodes / 1e3, 1),
        }
    ]


def memory(uri: str, sides: list[Side]) -> Rows:
    """Proportional set size of a process with one idle node."""
    rows = []
    for side in sides:
        if side.env.get("QUEUE"):
            continue
        with side.running(uri, "idle") as process:
            time.sleep(1)
            rows.append({"path": side.name, "MB": round(pss(psutil.Process(process.pid)) / 1e6, 1)})
    return rows


def packages(workspace: Path, *, folders: int) -> Rows:
    """A package path of many folders, of which a tenth are packages: a search, a check for changes."""
    for number in range(folders):
        folder = workspace / f"{number // 100}" / f"{number}"
        folder.mkdir(parents=True)
        if number % 10 == 0:
            (folder / "package.xml").write_text(f"<package><name>p{number}</name></package>")
    index = PackageIndex([workspace])
    took = {}
    for what in ("search", "check", "remembered"):
        if what == "check":
            index.expire()
        begin = time.perf_counter()
        index.find("p0")
        took[what] = time.perf_counter() - begin
    return [{"folders": folders, **{f"{what} ms": round(1e3 * value, 3) for what, value in took.items()}}]


@contextlib.contextmanager
def real_master(port: int) -> Iterator[str | None]:
    """A ``rosmaster`` to compare with, if there is one."""
    try:
        process = subprocess.Popen(
            ["/usr/bin/rosmaster", "--core", "-p", str(port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError:
        yield None
        return
    uri = f"http://127.0.0.1:{port}/"
    try:
        asyncio.run(_answers(uri))
        yield uri
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


async def _answers(uri: str) -> None:
    async with RpcClient() as rpc, asyncio.timeout(20):
        while True:
            with contextlib.suppress(RosError):
                await rpc.call(uri, "getPid", ("/x",))
                return
            await asyncio.sleep(0.1)
