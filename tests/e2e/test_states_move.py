"""The state of a node moves with its container: handed over, drained, or lost with its machine.

One master with its own store, and three on etcd of which the leading one is killed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.container_nodes import NODES
from support.engine import Program, engine_processes, until
from support.etcd import cluster
from support.master_program import environment, rce
from support.masters import DEV_USER, MasterProcess, Masters, masters
from support.ports import free_port

from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError, CliError

pytestmark = [pytest.mark.e2e, pytest.mark.needs("bwrap"), pytest.mark.timeout(600)]

NODE = {
    "tag": "count",
    "pkg": "Test",
    "exe": "counter.py",
    "state_services": {"save": "save_count", "restore": "restore_count", "every": 1},
}
FIXED = NODE | {"pkg": "own", "exe": "fixed_state.py"}
"""Its state is drawn when it starts, and stays."""
WAIT_S = 180.0
ENOUGH = 20
"""More than a counter that starts anew reaches before its first snapshot."""
NUMBERS = {hashlib.sha256(str(number).encode()).hexdigest(): number for number in range(100_000)}
"""Counts by the hashes of their snapshots."""


class Machine(Program):
    """A container task set, which takes itself to be on a machine of its own."""

    def __init__(self, folder: Path, name: str, hosts: str) -> None:
        self.folder = folder / name
        self.folder.mkdir()
        argv = [
            *(sys.executable, "-m", "rce_container", hosts, "--dev", "--runtime", "namespace"),
            *("--machine", name, "--state-dir", str(self.folder / "state")),
            *("--link-port", str(free_port())),
        ]
        env = environment(folder) | {
            "XDG_RUNTIME_DIR": str(self.folder),
            "RCE_PACKAGE_PATH": str(folder / "packages"),
        }
        super().__init__(name, argv, env, folder)

    async def lose(self) -> None:
        """Kill -9 the task set and all that it started, as when its machine is switched off."""
        found = engine_processes(self.folder)
        await self.kill()
        for process in found:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()


class Cloud:
    """An engine whose container counts."""

    def __init__(self, client: ApiClient, folder: Path, hosts: str) -> None:
        self.client = client
        self.machines = [Machine(folder, name, hosts) for name in ("first", "second")]

    async def call(self, method: str, path: str, body: Any = None) -> Any:
        """Ask the leading master, once there is one."""

        async def ask() -> list[Any]:
            try:
                return [await self.client.call(method, path, body)]
            except ApiError as error:
                if error.status not in (502, 503):
                    raise
            except CliError:
                pass
            return []

        return (await until(ask, timeout=WAIT_S, what=f"{method} {path}"))[0]

    async def state(self) -> dict[str, Any]:
        """Return what is known of the newest snapshot; empty if there is none."""
        found = (await self.call("GET", "/states"))["states"]
        return dict(found[0]) if found else {}

    async def count(self) -> int:
        """Return the count of the newest acknowledged snapshot."""
        found = await self.state()
        return NUMBERS[found["sha256"]] if found else 0

    async def passes(self, number: int, at: str) -> int:
        """Wait until a count over a number is acknowledged that was saved at a machine."""

        async def found() -> int:
            state = await self.state()
            if not state or state["machine"] != at:
                return 0
            count = NUMBERS[state["sha256"]]
            assert count >= number, f"{count} comes after {number}: it has forgotten"
            return count if count > number else 0

        return await until(found, timeout=WAIT_S, what=f"a count over {number} at {at}")

    async def is_up_at(self, machine: str) -> None:
        async def there() -> bool:
            (container,) = (await self.call("GET", "/containers"))["containers"]
            return (container["machine"], container["state"]) == (machine, "running")

        await until(there, timeout=WAIT_S, what=f"the container runs at {machine}")

    async def moves(self, act: Callable[[], Any], to: str, after: int) -> int:
        """Let the container go to a machine; check that it counts on from what was acknowledged."""
        await act()
        await self.is_up_at(to)
        return await self.passes(after, to)

    async def start(self, machine: Machine) -> None:
        """Start a task set, and wait until the master knows it."""
        await machine.start(ready="rce-container ready")
        await self.connected(machine.name)

    async def connected(self, *machines: str) -> None:
        """Wait until the leading master knows machines."""

        async def known() -> bool:
            found = (await self.call("GET", "/machines"))["machines"]
            return {one["machine"] for one in found if one["connected"]} >= set(machines)

        await until(known, timeout=WAIT_S, what=f"{machines} are connected")

    async def begin(self, *volumes: dict[str, Any]) -> None:
        """Start the counter at the first machine."""
        await self.start(self.machines[0])
        await self.call("POST", "/containers", {"tag": "C", "volumes": list(volumes)})
        await self.call("POST", "/containers/C/nodes", NODE)

        async def counts() -> bool:
            return await self.count() > ENOUGH

        await until(counts, timeout=WAIT_S, what=f"a count over {ENOUGH}")
        await self.start(self.machines[1])

    async def handed_over(self, to: str) -> int:
        before = await self.count()
        return await self.moves(
            lambda: self.call("PUT", "/containers/C/machine", {"machine": to}), to, before
        )

    async def drained(self, machine: str, to: str) -> int:
        before = await self.count()
        return await self.moves(lambda: self.call("PUT", f"/machines/{machine}/drain"), to, before)

    async def lost(self, machine: Machine, to: str) -> int:
        await machine.lose()
        before = await self.count()
        return await self.moves(self._nothing, to, before)

    async def _nothing(self) -> None:
        """The master moves it by itself."""


@asynccontextmanager
async def counting(folder: Path, url: str, token: str, hosts: str) -> AsyncIterator[Cloud]:
    package = folder / "packages" / "own"
    (package / "nodes").mkdir(parents=True)
    (package / "package.yaml").write_text("name: own\n")
    (package / "nodes" / "fixed_state.py").write_text(NODES["fixed_state.py"])
    async with AsyncExitStack() as stack:
        client = await stack.enter_async_context(ApiClient(url, token))
        cloud = Cloud(client, folder, hosts)
        for machine in cloud.machines:
            stack.push_async_callback(_end, machine)
        try:
            yield cloud
        except BaseException:
            for machine in cloud.machines:
                print(f"----- {machine.name}\n{machine.output()[-4000:]}")  # noqa: T201
            raise


async def _end(program: Program) -> None:
    if program.running:
        assert await program.stop() == 0, program.output()


class Single(MasterProcess):
    """A master with a store of its own."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "master", "", 3.0)
        at = self.argv.index("--store")
        del self.argv[at : at + 4]


async def log_in(master: MasterProcess) -> str:
    """Return a token of the user of development mode."""
    async with ApiClient(master.url) as client:
        body = {"userID": DEV_USER, "password": DEV_USER}
        return str((await client.call("POST", "/login", body))["token"])


@asynccontextmanager
async def single(folder: Path) -> AsyncIterator[tuple[MasterProcess, Cloud]]:
    """Run one master with its store in a file, and machines for nodes that count."""
    master = Single(folder)
    await master.start(ready="rce-master ready")
    try:
        hosts = f"127.0.0.1:{master.control_port}"
        async with counting(folder, master.url, await log_in(master), hosts) as cloud:
            yield master, cloud
    finally:
        assert await master.stop() == 0


async def test_a_count_moves_with_its_container(folder: Path) -> None:
    async with single(folder) as (master, cloud):
        await cloud.begin()
        await cloud.handed_over("second")
        await cloud.drained("second", "first")
        await cloud.call("DELETE", "/machines/second/drain")
        count = await cloud.lost(cloud.machines[0], "second")
        await master.kill()
        await master.start(ready="rce-master ready")
        await cloud.passes(count, "second")
        await cloud.start(cloud.machines[0])
        await cloud.handed_over("first")
        await check_commands(folder, master, cloud)
        await cloud.call("DELETE", "/containers/C")
        assert await cloud.state() == {}
        await until(lambda: not _contents(master), what="its contents are removed")


async def test_a_count_moves_with_a_volume(folder: Path) -> None:
    """A container with both is ended, moved with its files, and counts on from the snapshot."""
    async with single(folder) as (_, cloud):
        await cloud.begin({"name": "files", "path": "/data", "size": "16M"})
        await cloud.handed_over("second")
        await cloud.drained("second", "first")
        (volume,) = (await cloud.call("GET", "/volumes"))["volumes"]
        assert volume["machine"] == "first"
        await cloud.call("DELETE", "/containers/C")


async def test_a_state_is_saved_when_it_moves_with_a_volume(folder: Path) -> None:
    """It was never saved before; the node has it again at the next machine, and is saved there for a move."""
    async with single(folder) as (_, cloud):
        await cloud.start(cloud.machines[0])
        volume = {"name": "files", "path": "/data", "size": "16M"}
        await cloud.call("POST", "/containers", {"tag": "C", "volumes": [volume]})
        services = {"save": "save_count", "restore": "restore_count", "every": 86400}
        await cloud.call("POST", "/containers/C/nodes", FIXED | {"state_services": services})

        async def runs() -> bool:
            (node,) = (await cloud.call("GET", "/nodes"))["nodes"]
            return bool(node["state"] == "running")

        await until(runs, timeout=WAIT_S, what="the node runs")
        await cloud.start(cloud.machines[1])
        await cloud.call("PUT", "/containers/C/machine", {"machine": "second"})
        await cloud.is_up_at("second")
        first = await cloud.state()
        assert first["machine"] == "first"
        await until(runs, timeout=WAIT_S, what="the node runs there")
        await cloud.call("PUT", "/machines/second/drain")
        await cloud.is_up_at("first")
        state = await cloud.state()
        assert (state["machine"], state["sha256"]) == ("second", first["sha256"])
        await cloud.call("DELETE", "/containers/C")


async def test_a_state_that_was_removed_moves(folder: Path) -> None:
    """It has not changed since its snapshot, and the node that has it is saved for the move."""
    async with single(folder) as (_, cloud):
        await cloud.start(cloud.machines[0])
        await cloud.call("POST", "/containers", {"tag": "C"})
        await cloud.call("POST", "/containers/C/nodes", FIXED)
        first = await until(cloud.state, timeout=WAIT_S, what="the state is saved")
        await cloud.start(cloud.machines[1])
        await cloud.call("DELETE", "/states/C/count")
        assert await cloud.state() == {}
        await cloud.call("PUT", "/containers/C/machine", {"machine": "second"})
        await cloud.is_up_at("second")

        async def saved_there() -> dict[str, Any]:
            state = await cloud.state()
            return state if state.get("machine") == "second" else {}

        state = await until(saved_there, timeout=WAIT_S, what="the state is saved there")
        assert state["sha256"] == first["sha256"]
        await cloud.call("DELETE", "/containers/C")


async def check_commands(folder: Path, master: MasterProcess, cloud: Cloud) -> None:
    """``rce state`` lists the snapshot, and removes it; a node that runs is saved again."""
    login = {"url": master.url, "user": DEV_USER, "token": await log_in(master), "expires": 2e10}
    (folder / "login.json").write_text(json.dumps(login))
    listed = await rce(folder, "state", "list")
    assert "C/count" in listed
    assert "first" in listed
    assert "removed" in await rce(folder, "state", "remove", "C/count", "--yes")
    assert "names no node" in await rce(folder, "state", "remove", "C", "--yes", code=2)
    before = await cloud.count()
    await cloud.passes(before, "first")


@pytest.mark.needs("etcd")
async def test_a_count_outlives_the_leading_master(folder: Path) -> None:
    async with cluster(folder / "etcd", 3) as etcd, masters(folder / "masters", etcd.store) as made:
        hosts = ",".join(f"127.0.0.1:{master.control_port}" for master in made.all)
        urls = ",".join(master.url for master in made.all)
        async with counting(folder, urls, made.token, hosts) as cloud:
            await cloud.begin()
            count = await check_majority(made, cloud)
            first = await made.leader()
            await first.kill()
            await made.leader(but=first)
            assert await cloud.count() >= count, "it was acknowledged"
            await cloud.connected("first", "second")
            await cloud.handed_over("second")
            await first.start(ready="rce-master stand-by: ")
            second = await made.leader()
            await cloud.machines[1].lose()
            count = await cloud.count()
            await second.kill()
            await made.leader(but=second)
            await cloud.moves(cloud._nothing, "first", count)
            await second.start(ready="rce-master stand-by: ")
            count = await cloud.count()
            await cloud.start(cloud.machines[1])
            await cloud.passes(count, "first")


async def check_majority(made: Masters, cloud: Cloud) -> int:
    """Check that more than half of the masters hold the newest snapshot; return its count."""

    async def held() -> int:
        sha256 = (await cloud.state())["sha256"]
        holders = [master for master in made.all if sha256 in _contents(master)]
        # A newer snapshot may have taken its place while it was looked for.
        return NUMBERS[sha256] if len(holders) > len(made.all) // 2 else 0

    return await until(held, timeout=WAIT_S, what="a majority holds it")


def _contents(master: MasterProcess) -> set[str]:
    folder = master.log.parent / master.name / "bundles"
    return {path.name for path in folder.glob("?" * 64)}
