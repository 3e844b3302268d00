"""Measure etcd as the store of the masters: ``python -m benchmarks.store [--quick]``. It needs no engine.

Three members run on this machine. ``save`` is a compare-and-set of ``rows`` rows of 1 kB in one transaction,
one after the other. ``idle`` is what one member takes beside a
leading master and two stand-bys, which renew the lease and follow the state: the greatest of the three.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import shutil
import tempfile
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from time import perf_counter
from typing import Any

import psutil

from benchmarks.engine import BIN, free_ports, pss
from benchmarks.figures import Results, percentile, show
from benchmarks.targets import beside_targets
from rce.supervision.process import Child
from rce_master.exceptions import StoreError
from rce_master.store.base import Row
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.layout import MAX_OPERATIONS, prepare
from rce_master.store.etcd.store import EtcdStore

MEMBERS = 3
ROWS = (1, 16, 64)
BODY = b"x" * 1000
START_S = 60.0
SETTLE_S = 5.0
"""From the start of the masters until etcd is measured."""
IDLE_S, SAVES = 30.0, 1000
QUICK_IDLE_S, QUICK_SAVES = 10.0, 200
_NO_OUTPUT = asyncio.subprocess.DEVNULL


@contextlib.asynccontextmanager
async def etcd(folder: Path) -> AsyncIterator[tuple[list[str], list[psutil.Process]]]:
    """Run members; yield their endpoints and processes."""
    ports = free_ports(2 * MEMBERS)
    clients, peers = ports[:MEMBERS], ports[MEMBERS:]
    names = [f"m{number}=http://127.0.0.1:{port}" for number, port in enumerate(peers)]
    processes = []
    try:
        for number, (client, peer) in enumerate(zip(clients, peers, strict=True)):
            urls = (f"http://127.0.0.1:{client}", f"http://127.0.0.1:{peer}")
            argv = [
                *("etcd", "--name", f"m{number}", "--data-dir", str(folder / f"m{number}")),
                *("--listen-client-urls", urls[0], "--advertise-client-urls", urls[0]),
                *("--listen-peer-urls", urls[1], "--initial-advertise-peer-urls", urls[1]),
                *("--initial-cluster", ",".join(names), "--pre-vote", "--log-level", "error"),
                *("--max-txn-ops", str(MAX_OPERATIONS), "--max-request-bytes", str(16 << 20)),
            ]
            processes.append(
                await asyncio.create_subprocess_exec(*argv, stdout=_NO_OUTPUT, stderr=_NO_OUTPUT)
            )
        yield [f"127.0.0.1:{port}" for port in clients], [psutil.Process(one.pid) for one in processes]
    finally:
        for one in processes:
            one.kill()
            await one.wait()


async def saves(endpoints: list[str], count: int) -> list[dict[str, Any]]:
    """Save rows again and again; one line for each number of rows."""
    found = []
    async with EtcdClient(endpoints) as client:
        await _prepared(client)
        store = EtcdStore(client, "/bench")
        term = await store.begin_term()
        for rows in ROWS:
            print(f"{count} saves of {rows} rows", flush=True)
            times = []
            for number in range(count):
                made = [Row("t", f"{(number * rows + each) % 1000}", BODY) for each in range(rows)]
                began = perf_counter()
                await store.save(made, term)
                times.append(1e3 * (perf_counter() - began))
            p50, p99 = percentile(times, 0.5), percentile(times, 0.99)
            found.append({"rows": rows, "p50_ms": round(p50, 2), "p99_ms": round(p99, 2)})
    return found


async def _prepared(client: EtcdClient) -> None:
    end = perf_counter() + START_S
    while True:
        try:
            await prepare(client, "/bench")
        except StoreError:
            if perf_counter() >= end:
                raise
            await asyncio.sleep(0.2)
        else:
            return


async def idle(
    endpoints: list[str], members: list[psutil.Process], folder: Path, seconds: float
) -> dict[str, Any]:
    """Run masters that have nothing to do, and measure the members."""
    async with AsyncExitStack() as stack:
        for number in range(MEMBERS):
            print(f"a master starts: {number + 1} of {MEMBERS}", flush=True)
            http, control = free_ports(2)
            argv = [
                *(str(BIN / "rce-master"), "--dev", "--store", f"etcd://{','.join(endpoints)}"),
                *("--http-port", str(http), "--control-port", str(control)),
                *("--machine", f"m{number}", "--state-dir", str(folder / f"master{number}")),
            ]
            env = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "RCE_SECRET": "of a benchmark"}
            child = await Child.start(f"master {number}", argv, env=env)
            stack.push_async_callback(child.stop, timeout=60)
            async for line in child.lines():
                if "stand-by: " in line:
                    break
            else:
                raise RuntimeError(f"master {number} ended")
        print(f"etcd is measured beside idle masters for {seconds:g} s", flush=True)
        await asyncio.sleep(SETTLE_S)
        before = [_used(member) for member in members]
        await asyncio.sleep(seconds)
        cores = [(_used(member) - was) / seconds for member, was in zip(members, before, strict=True)]
        return {
            "cores_percent": round(100 * max(cores), 2),
            "PSS MB": round(max(map(pss, members)) / 1e6, 1),
        }


def _used(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


async def measure(*, quick: bool) -> dict[str, list[dict[str, Any]]]:
    """Measure a fresh etcd, then one that saves."""
    folder = Path(tempfile.mkdtemp(prefix="rce-bench-", dir="/tmp"))
    try:
        async with etcd(folder) as (endpoints, members):
            quiet = await idle(endpoints, members, folder, QUICK_IDLE_S if quick else IDLE_S)
            return {"save": await saves(endpoints, QUICK_SAVES if quick else SAVES), "idle": [quiet]}
    finally:
        shutil.rmtree(folder)


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.store", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer saves and seconds")
    options = parser.parse_args()
    results = Results("store", quick=options.quick)
    suites = asyncio.run(measure(quick=options.quick))
    show("A save in etcd, three members", suites["save"])
    show("One member of etcd beside idle masters", suites["idle"])
    show("Beside the targets", list(beside_targets("store", suites)))
    for name, rows in suites.items():
        results.keep(name, rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
