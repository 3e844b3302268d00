"""Make and destroy many containers, and count what is left: ``python -m benchmarks.soak [--count N]``.

``--flood MB`` has a node write so much to its standard output instead, as fast as it is let.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import tempfile
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import uvloop

from benchmarks.engine import RunningEngine, engine, words
from benchmarks.figures import Results, show
from benchmarks.wire import Robot, robot, serialized_string, wire_echo
from tools.leaks import Traces, footprint

BATCHES = 10
MAX_GROWTH_MB = 32.0
"""The maximum growth of memory and logs by a flood."""
SERIAL = 4
"""One of this many containers is made after the former one has ended; others :data:`WORKERS` at a time."""
WORKERS = 4
SETTLE_S = 60.0
WORTH_KEEPING = 1000
"""Results of so many containers are saved."""
MB = 1 << 20
TAGS = ("request", "response", "service")
PROGRAMS = {
    "master": "rce_master",
    "robot": "rce_robot",
    "manager": "rce_container",
    "fork server": "rce_container.forkserver",
}
FLOOD = f"""
import os, sys, time
piece, left = (b"x" * 99 + b"\\n") * 10_000, int(sys.argv[1]) * {MB}
while left > 0:
    left -= os.write(1, piece)
print("flooded", flush=True)
time.sleep(600)
"""


class Soak:
    """One engine through many containers."""

    def __init__(self, running: RunningEngine, workers: list[Robot]) -> None:
        self._workers = workers
        self._prefix = f"soak{running.pid}n"
        self._traces = Traces(running.folder, self._prefix)
        self._pids = {kind: find(running, module) for kind, module in PROGRAMS.items()}
        self._programs = {one.pid for one in self._traces.look()}
        self._made = 0
        self._start = perf_counter()

    async def run(self, count: int) -> AsyncIterator[dict[str, Any]]:
        """Make and destroy containers; yields what there is before, and after each batch."""
        yield self.row()
        for batch in range(BATCHES):
            size = count * (batch + 1) // BATCHES - count * batch // BATCHES
            serial = size // SERIAL
            await self._work(self._workers[0], serial)
            shares = [(size - serial + n) // len(self._workers) for n in range(len(self._workers))]
            async with asyncio.TaskGroup() as tasks:
                for worker, share in zip(self._workers, shares, strict=True):
                    tasks.create_task(self._work(worker, share))
            await self._settle()
            yield self.row()

    async def _work(self, worker: Robot, count: int) -> None:
        for _ in range(count):
            self._made += 1
            await live(worker, f"{self._prefix}{self._made}")

    async def _settle(self) -> None:
        deadline = perf_counter() + SETTLE_S
        while self.left() and perf_counter() < deadline:  # noqa: ASYNC110 - processes send no events
            await asyncio.sleep(0.2)

    def left(self) -> list[str]:
        """Return the engine's remains beside its programs."""
        return self._traces.left(self._programs)

    def row(self) -> dict[str, Any]:
        """Return the present counts."""
        left = Counter(text.split()[0] for text in self.left())
        row: dict[str, Any] = {"made": self._made, "seconds": round(perf_counter() - self._start)}
        for kind, pid in self._pids.items():
            found = footprint(pid)
            row[f"{kind} MB"] = round(found.memory / MB, 1)
            row[f"{kind} fds"] = found.fds
        for kind in ("process", "mount", "cgroup", "interface", "file"):
            row[kind] = left[kind]
        return row


async def live(worker: Robot, container: str) -> None:
    """Make a container with a node, have the node answer, and destroy it."""
    await wire_echo(worker, "Forwarder", container)
    await worker.send_forwarded("request", serialized_string(5))
    await worker.receive_binary()
    await worker.send("DC", {"containerTag": container})
    await worker.wait_inactive(*TAGS)


def find(running: RunningEngine, module: str) -> int:
    """The process of the engine that runs a module; 0 if there is none."""
    return next((one.pid for one in running.named(module) if words(one)[1:4].count(module)), 0)


async def soak(count: int, runtime: str) -> list[str]:
    """Run it; return a text about the remains."""
    results, rows = Results("soak"), []
    async with engine(runtime) as running, AsyncExitStack() as stack:
        workers = [await stack.enter_async_context(robot(running.url, f"worker{n}")) for n in range(WORKERS)]
        await live(workers[0], "warm")
        soaking = Soak(running, workers)
        async for row in soaking.run(count):
            rows.append(row)
            print(row, flush=True)
        left = soaking.left()
        traces = Traces(running.folder)
        traces.look()
    left += traces.left()
    show(
        f"{count} containers made and destroyed",
        [{k: v for k, v in row.items() if "fds" not in k} for row in rows],
    )
    if count >= WORTH_KEEPING:
        results.keep("soak", rows)
        results.keep("left", left)
        print("results:", results.save())
    return left


async def flood(megabytes: int, runtime: str) -> list[str]:
    """Have a node flood its log; return a text about the faults."""
    results = Results("flood")
    async with engine(runtime) as running, robot(running.url, "flooder") as client:
        await wire_echo(client, "Forwarder", "flooded")
        environment = find(running, "rce_container.environment")
        pids = {"environment": environment, "manager": find(running, "rce_container")}
        rows = [{"when": "before", **weigh(running, pids)}]
        node = {"containerTag": "flooded", "nodeTag": "flood", "pkg": "soak", "exe": "flood.py"}
        start = perf_counter()
        await client.send("CN", {"addNodes": [{**node, "args": str(megabytes)}]})
        while not logged(running, b"flooded\n"):  # noqa: ASYNC110 - it is a file
            await asyncio.sleep(0.5)
        seconds = perf_counter() - start
        await client.send_forwarded("request", serialized_string(5))
        await client.receive_binary()
        rows.append({"when": f"after {megabytes} MB in {seconds:.0f} s", **weigh(running, pids)})
    show("A node floods its standard output", rows)
    results.keep("flood", rows)
    print("results:", results.save())
    before, after = rows
    return [
        f"{name} grew from {before[name]} to {after[name]}"
        for name in before
        if name != "when" and after[name] > before[name] + MAX_GROWTH_MB
    ]


def weigh(running: RunningEngine, pids: dict[str, int]) -> dict[str, Any]:
    """Memory of processes, and the size of the node's log."""
    sizes = [path.stat().st_size for path in logs(running) if path.exists()]
    memory = {f"{kind} MB": round(footprint(pid).memory / MB, 1) for kind, pid in pids.items()}
    return {**memory, "log MB": round(sum(sizes) / MB, 1)}


def logs(running: RunningEngine) -> list[Path]:
    """The pieces of the flooding node's log."""
    return sorted(running.folder.rglob("flood.[0-9]*.log"))


def logged(running: RunningEngine, text: bytes) -> bool:
    """Whether the node's log ends with this."""
    with suppress(FileNotFoundError):  # old pieces are dropped
        return any(text in path.read_bytes()[-4096:] for path in logs(running)[-1:])
    return False


def package(folder: Path) -> None:
    """Make a package with the node that floods, and let the engine find it."""
    nodes = folder / "soak" / "nodes"
    nodes.mkdir(parents=True)
    folder.chmod(0o755)
    (folder / "soak" / "package.yaml").write_text("name: soak\n")
    (nodes / "flood.py").write_text(FLOOD)
    os.environ["RCE_PACKAGE_PATH"] = str(folder)


def main() -> None:
    """Read the command line and soak."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="containers")
    parser.add_argument(
        "--flood", type=int, default=0, metavar="MB", help="have a node flood its log instead"
    )
    parser.add_argument("--runtime", default="auto", choices=("auto", "namespace", "process"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rce-soak-", dir="/tmp") as folder:
        package(Path(folder))
        running = (
            flood(options.flood, options.runtime) if options.flood else soak(options.count, options.runtime)
        )
        left = uvloop.run(running)
    if left:
        sys.exit("\n".join(["not as it should be:", *left]))


if __name__ == "__main__":
    main()
