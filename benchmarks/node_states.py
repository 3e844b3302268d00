"""The cost of keeping nodes' states: how long a master takes to acknowledge and to return a snapshot."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from time import perf_counter
from typing import Any

import psutil

from benchmarks.engine import BIN, free_ports
from benchmarks.figures import spread
from rce.config import Secret
from rce.control import (
    CONTROL_VERSION,
    NODE_STATES,
    EndpointState,
    EndpointStatus,
    Hello,
    MachineInfo,
    Put,
    Status,
    TaskSetKind,
    ToTaskSet,
)
from rce.control.node_states import Fetch, Keep
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.dialing import Dialer
from rce.control_channel.node_states import NodeStateClient
from rce.masters import Masters
from rce.model import MAX_STATE
from rce.supervision.process import Child
from rce_master.cli.client import ApiClient

SIZES = {"1 kB": 1 << 10, "1 MB": 1 << 20, "16 MB": 16 << 20}
USER, PROCESS, INCARNATION, NODE = "testUser", "bench", "one", "n"
CONTAINER = f"{USER}/box"
_SECRET = "of a benchmark"
_SERVICES = {"save": "save", "restore": "restore"}


class _TaskSet:
    """A container task set that reports its container as running, and runs none."""

    def __init__(self, masters: Masters) -> None:
        self.is_placed = asyncio.Event()
        self.channel = TaskSetChannel(masters, Secret(_SECRET), self._hello, self._handle)

    def _hello(self) -> Hello:
        return Hello(
            version=CONTROL_VERSION,
            kind=TaskSetKind.CONTAINER,
            process=PROCESS,
            machine=MachineInfo(name=PROCESS, cores=1, slots=1),
            features=(NODE_STATES,),
        )

    async def _handle(self, message: ToTaskSet) -> None:
        if isinstance(message, Put) and message.endpoint.nodes:
            revision, state = message.endpoint.revision, EndpointState.RUNNING
            status = EndpointStatus(id=CONTAINER, revision=revision, state=state, incarnation=INCARNATION)
            self.channel.send(Status(status=status))
            self.is_placed.set()


async def run(*, count: int) -> list[dict[str, Any]]:
    """Keep and fetch snapshots one after another; one row for each size and direction."""
    rows: list[dict[str, Any]] = []
    async with _master() as (child, client):
        process, number = psutil.Process(child.pid), 0
        for name, size in SIZES.items():
            kept, fetched = [], []
            before = process.cpu_times()
            for _ in range(count):
                number += 1
                state = os.urandom(size)
                kept.append(await _timed(client.keep(_question(state, number), state)))
                fetched.append(await _timed(client.fetch(_ASKED, MAX_STATE)))
            now = process.cpu_times()
            cpu_ms = 1e3 * (now.user + now.system - before.user - before.system) / count
            rows += [
                {"snapshot": name, "way": "kept", **spread(kept), "master cpu_ms of both": round(cpu_ms, 1)},
                {"snapshot": name, "way": "fetched", **spread(fetched)},
            ]
    return rows


_ASKED = Fetch(process=PROCESS, id=CONTAINER, node=NODE)


def _question(state: bytes, number: int) -> Keep:
    return Keep(
        process=PROCESS,
        id=CONTAINER,
        node=NODE,
        incarnation=INCARNATION,
        number=number,
        size=len(state),
        sha256=hashlib.sha256(state).hexdigest(),
    )


async def _timed(work: Any) -> float:
    start = perf_counter()
    await work
    return perf_counter() - start


@contextlib.asynccontextmanager
async def _master() -> AsyncIterator[tuple[Child, NodeStateClient]]:
    """Run a master with one container, whose node keeps its state."""
    folder = Path(tempfile.mkdtemp(prefix="rce-bench-", dir="/tmp"))
    http, control = free_ports(2)
    argv = [str(BIN / "rce-master"), "--dev", "--state-dir", str(folder / "state")]
    argv += ["--http-port", str(http), "--control-port", str(control)]
    child = await Child.start("rce-master", argv, env={**os.environ, "RCE_SECRET": _SECRET})
    tasks: list[asyncio.Task[None]] = []
    try:
        async for line in child.lines():
            if " ready: " in line:
                break
        tasks.append(asyncio.create_task(_read(child)))
        masters = Masters(f"ws://127.0.0.1:{control}")
        task_set = _TaskSet(masters)
        tasks.append(asyncio.create_task(task_set.channel.run()))
        await task_set.channel.wait_connected()
        await _create(f"http://127.0.0.1:{http}/")
        await task_set.is_placed.wait()
        yield child, NodeStateClient(Dialer(masters, Secret(_SECRET)))
    finally:
        for task in tasks:
            task.cancel()
        await child.stop(timeout=60)
        await asyncio.gather(*tasks, return_exceptions=True)
        shutil.rmtree(folder)


async def _create(url: str) -> None:
    async with ApiClient(url) as client:
        token = (await client.call("POST", "/login", {"userID": USER, "password": USER}))["token"]
    async with ApiClient(url, token) as client:
        await client.call("POST", "/containers", {"tag": "box"})
        node = {"tag": NODE, "pkg": "Test", "exe": "counter.py", "state_services": _SERVICES}
        await client.call("POST", "/containers/box/nodes", node)


async def _read(child: Child) -> None:
    async for _ in child.lines():
        pass
