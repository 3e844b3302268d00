"""Packages that users push to one of three masters: more than half hold them before they are accepted."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import pytest_asyncio
from support.engine import Program, until
from support.etcd import Cluster, cluster
from support.master_program import environment
from support.masters import MasterProcess, Masters, masters
from support.ports import free_port
from support.pushed import Pushed
from support.user_packages import KEY

from rce_master.leadership.registry import MasterRegistry
from rce_master.store.etcd import EtcdClient

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

LEASE_S = 10.0
"""Of a loaded machine: a leader that etcd keeps waiting for some seconds still leads."""
WAIT_S = 120.0


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def etcd(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Cluster]:
    async with cluster(tmp_path_factory.mktemp("etcd"), 3) as made:
        yield made


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_masters(etcd: Cluster, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Masters]:
    """Three masters that know each other."""
    async with masters(tmp_path_factory.mktemp("masters"), etcd.store, lease=LEASE_S) as made:
        async with EtcdClient(etcd.endpoints, attempt=20.0) as client:
            registry = MasterRegistry(client, "/rce", "the test")

            async def know_each_other() -> bool:
                return len(await registry.others()) == len(made.all)

            await until(know_each_other, timeout=WAIT_S, what="the masters know each other")
        body = {"key": KEY.public, "label": "tests"}
        await call(made, "POST", "package-keys", status=201, json=body)
        yield made


async def call(made: Masters, method: str, path: str, *, status: int, **options: Any) -> str:
    """Ask the leading master; return the text of its answer."""
    leader = await made.leader()
    got, text = await made.ask(method, f"{leader.url}api/v1/{path}", **options)
    assert got == status, text
    return text


async def restart(master: MasterProcess) -> None:
    await master.start(ready="rce-master stand-by: ")


@asynccontextmanager
async def containers(made: Masters, folder: Path) -> AsyncIterator[Program]:
    """Run a container task set that knows all masters."""
    hosts = ",".join(f"127.0.0.1:{master.control_port}" for master in made.all)
    argv = [
        *(sys.executable, "-m", "rce_container", hosts, "--dev", "--runtime", "process"),
        *("--state-dir", str(folder / "state"), "--link-port", str(free_port())),
    ]
    program = Program("containers", argv, environment(folder) | {"XDG_RUNTIME_DIR": str(folder)}, folder)
    await program.start(ready="rce-container ready")
    try:
        yield program
    finally:
        assert await program.stop() == 0, program.output()


async def node_runs(made: Masters, container: str) -> None:
    """Wait until the only node of a container runs."""

    async def runs() -> bool:
        leader = await made.leader()
        async with made.session(30.0) as session:
            try:
                async with session.get(f"{leader.url}api/v1/nodes") as reply:
                    nodes = (await reply.json()).get("nodes", [])
            except (aiohttp.ClientError, TimeoutError):
                return False  # the lead changes just now
        return any(node["container"] == container and node["pid"] for node in nodes)

    await until(runs, timeout=WAIT_S, what=f"the node of {container} runs")


async def start_node(made: Masters, package: str) -> None:
    await call(made, "POST", "containers", json={"tag": package}, status=204)
    body = {"tag": "node", "pkg": package, "exe": "run.py"}
    await call(made, "POST", f"containers/{package}/nodes", json=body, status=204)


async def test_a_package_outlives_the_leader_that_took_it(shared_masters: Masters, tmp_path: Path) -> None:
    first = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not first)
    pushed = Pushed(tmp_path, "outlives")
    await pushed.push(shared_masters, standby)
    assert len(pushed.holders(shared_masters)) >= 2, "a minority held it when it was accepted"
    await first.kill()
    async with containers(shared_masters, tmp_path):
        await start_node(shared_masters, "outlives")
        await node_runs(shared_masters, "outlives")
    await pushed.until_held(shared_masters, 3)
    pushed.path(first).unlink()
    await restart(first)
    await pushed.until_held(shared_masters, 3)


async def test_a_new_leader_fetches_what_it_lacks(shared_masters: Masters, tmp_path: Path) -> None:
    """The only other master that lives at first has the archive no more; a node waits until another comes."""
    leader = await shared_masters.leader()
    heir, holder = (master for master in shared_masters.all if master is not leader)
    pushed = Pushed(tmp_path, "lacked")
    await pushed.push(shared_masters, leader)
    await pushed.until_held(shared_masters, 3)
    assert await holder.stop() == 0
    async with containers(shared_masters, tmp_path) as program:
        pushed.path(heir).unlink()
        await leader.kill()
        assert await shared_masters.leader(but=leader) is heir
        await start_node(shared_masters, "lacked")
        told = "no other master gives the archive"
        await until(lambda: told in program.output(), timeout=WAIT_S, what="the node waits")
        assert not pushed.path(heir).exists()
        await restart(holder)
        await node_runs(shared_masters, "lacked")
    assert pushed.path(heir).read_bytes() == pushed.archive
    await restart(leader)


async def test_a_push_without_a_majority_is_refused(shared_masters: Masters, tmp_path: Path) -> None:
    leader = await shared_masters.leader()
    others = [master for master in shared_masters.all if master is not leader]
    for other in others:
        assert await other.stop() == 0
    pushed = Pushed(tmp_path, "alone")
    told = await pushed.push(shared_masters, leader, status=503)
    assert "more than half of the 3 masters, and 1 more must take it" in told
    assert all(other.name in told for other in others)
    await pushed.until_held(shared_masters, 0)
    assert '"alone"' not in await call(shared_masters, "GET", "packages", status=200)
    await restart(others[0])
    await pushed.push(shared_masters, leader)
    assert len(pushed.holders(shared_masters)) == 2
    await restart(others[1])
    await pushed.until_held(shared_masters, 3)
    await call(shared_masters, "DELETE", "packages/alone/1.0", status=204)
    await pushed.until_held(shared_masters, 0)


async def test_only_masters_get_archives_of_a_stand_by(shared_masters: Masters, tmp_path: Path) -> None:
    leader = await shared_masters.leader()
    standby = next(master for master in shared_masters.all if master is not leader)
    path = f"{standby.url}archives/{'0' * 64}"
    async with shared_masters.session(30.0) as session, AsyncExitStack() as stack:
        for method in ("GET", "PUT", "DELETE"):
            headers = {"RCE-Master": f"999 {'0' * 64}"}
            reply = await stack.enter_async_context(session.request(method, path, headers=headers))
            assert (reply.status, await reply.text()) == (403, "only masters of this engine may ask for this")
        reply = await stack.enter_async_context(session.get(f"{leader.url}archives"))
        assert reply.status == 404, "the leader asks, and is not asked"
