"""Snapshots of volumes at three masters: more than half hold them, and a new leader gives them out."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from support.engine import Program, until
from support.etcd import cluster
from support.master_program import environment
from support.masters import MasterProcess, Masters, masters
from support.ports import free_port

from rce_master.leadership.registry import MasterRegistry
from rce_master.store.etcd import EtcdClient

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.timeout(600)]

LEASE_S = 4.0
WAIT_S = 180.0
KEEP = (
    "import os, pathlib, time\n"
    "file = pathlib.Path(os.environ['RCE_VOLUME_JOURNAL']) / 'runs'\n"
    "with file.open('a') as runs:\n"
    "    runs.write('run ')\n"
    "print(len(file.read_text().split()), 'runs', flush=True)\n"
    "time.sleep(3600)\n"
)
VOLUME = {"name": "journal", "path": "/data", "size": "16M", "snapshots": 5}


async def ask(made: Masters, method: str, path: str, body: Any = None) -> Any:
    """Ask the leading master; None while the lead changes, or the machines are not connected to it yet."""
    leader = await made.leader()
    try:
        async with (
            made.session(30.0) as session,
            session.request(method, f"{leader.url}api/v1/{path}", json=body) as reply,
        ):
            if reply.status >= 300:
                return None
            return await reply.json() if reply.status == 200 else reply.status
    except (aiohttp.ClientError, TimeoutError):
        return None


@asynccontextmanager
async def machine(made: Masters, folder: Path, name: str) -> AsyncIterator[Program]:
    """Run a container task set that knows all masters."""
    packages = folder / "packages" / "own" / "nodes"
    if not packages.exists():
        packages.mkdir(parents=True)
        (packages / "keep.py").write_text(KEEP)
        (packages.parent / "package.yaml").write_text("name: own\n")
    hosts = ",".join(f"127.0.0.1:{master.control_port}" for master in made.all)
    argv = [
        *(sys.executable, "-m", "rce_container", hosts, "--dev", "--runtime", "process", "--machine", name),
        *("--state-dir", str(folder / name), "--link-port", str(free_port())),
    ]
    env = environment(folder) | {
        "XDG_RUNTIME_DIR": str(folder),
        "RCE_PACKAGE_PATH": str(folder / "packages"),
    }
    program = Program(name, argv, env, folder)
    await program.start(ready="rce-container ready")
    try:
        yield program
    finally:
        if program.running:
            assert await program.stop() == 0, program.output()


def holders(made: Masters) -> list[MasterProcess]:
    """Return the masters that hold parts of snapshots."""
    found = []
    for master in made.all:
        folder = master.log.parent / master.name / "snapshots"
        if folder.is_dir() and any(path.is_file() for path in folder.iterdir()):
            found.append(master)
    return found


async def test_a_snapshot_outlives_the_leader_that_took_it(tmp_path: Path) -> None:
    (tmp_path / "etcd").mkdir()
    (tmp_path / "masters").mkdir()
    async with (
        cluster(tmp_path / "etcd", 3) as etcd,
        masters(tmp_path / "masters", etcd.store, lease=LEASE_S) as made,
        AsyncExitStack() as stack,
    ):
        async with EtcdClient(etcd.endpoints, attempt=20.0) as client:
            registry = MasterRegistry(client, "/rce", "the test")

            async def know_each_other() -> bool:
                return len(await registry.others()) == len(made.all)

            await until(know_each_other, timeout=WAIT_S, what="the masters know each other")
        first = await stack.enter_async_context(machine(made, tmp_path, "first"))
        await ask(made, "POST", "containers", {"tag": "C", "volumes": [VOLUME]})
        node = {"tag": "keep", "pkg": "own", "exe": "keep.py"}
        await ask(made, "POST", "containers/C/nodes", node)

        async def log_tells(text: str) -> bool:
            found = await ask(made, "GET", "containers/C/nodes/keep/log?stream=stdout")
            return found is not None and text in found["text"]

        async def volume() -> dict[str, Any] | None:
            found = await ask(made, "GET", "volumes")
            return None if found is None else found["volumes"][0]

        async def has_snapshot() -> bool:
            found = await volume()
            assert found is None or found["fault"] == ""
            return found is not None and found["snapshot"] is not None and found["kept"] > 0

        await until(lambda: log_tells("1 runs"), timeout=WAIT_S, what="the first run")
        await until(has_snapshot, timeout=WAIT_S, what="a snapshot")
        assert len(holders(made)) >= 2, "a minority held it when it was accepted"
        await stack.enter_async_context(machine(made, tmp_path, "second"))
        leader = await made.leader()
        await leader.kill()
        await made.leader(but=leader)

        async def moves() -> bool:
            return await ask(made, "PUT", "containers/C/machine", {"machine": "second"}) is not None

        await until(moves, timeout=WAIT_S, what="the move begins")
        await until(lambda: log_tells("2 runs"), timeout=WAIT_S, what="the second run")
        await leader.start(ready="rce-master stand-by: ")
        await until(lambda: len(holders(made)) == 3, timeout=WAIT_S, what="all hold the newest snapshot")

        async def is_first_empty() -> bool:
            return not (tmp_path / "first" / "volumes" / "testUser" / "journal").exists()

        await until(is_first_empty, timeout=WAIT_S, what="the former files are removed")
        assert first.running
