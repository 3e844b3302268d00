"""A database under writes moves between machines, while master and managers are killed; no row is lost.

The node writes a row, waits until it is on the disk, and only then notes it as acknowledged in a folder that
all machines of the test share. There it also holds a lock, so that two that run at the same time are found.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import sqlite3
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import psutil
import pytest
from support.engine import Engine, Program, running_engine, until

from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError, CliError

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600)]

WAIT_S = 180.0
NOT_YET = ("its former files are still being removed there", "that machine is away")
ROWS = """
import fcntl, os, pathlib, sqlite3, sys, time, uuid
shared = pathlib.Path(sys.argv[1])
lock = open(shared / "lock", "w")
try:
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
except OSError:
    (shared / "twice").write_text(os.environ["RCE_VOLUME_JOURNAL"])
    raise
folder = pathlib.Path(os.environ["RCE_VOLUME_JOURNAL"])
if not (folder / "ballast").exists():
    (folder / "ballast").write_bytes(os.urandom(24 << 20))
database = sqlite3.connect(folder / "rows.sqlite", isolation_level=None)
database.execute("pragma journal_mode = wal")
database.execute("pragma synchronous = full")
database.execute("create table if not exists rows (name text primary key)")
acknowledged = os.open(shared / "acknowledged", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
while True:
    name = uuid.uuid4().hex
    database.execute("insert into rows values (?)", (name,))
    os.write(acknowledged, name.encode() + b"\\n")
    time.sleep(0.002)
"""


class Moved:
    """An engine with two container machines, and a container with a database on one of them."""

    def __init__(self, engine: Engine, shared: Path, client: ApiClient) -> None:
        self.engine = engine
        self._shared = shared
        self._client = client

    async def create(self, **volume: Any) -> None:
        body = {"name": "journal", "path": "/data", "size": "64M", **volume}
        await self._client.call("POST", "/containers", {"tag": "C", "volumes": [body]})
        node = {"tag": "rows", "pkg": "own", "exe": "rows.py", "args": str(self._shared), "restart": "always"}
        await self._client.call("POST", "/containers/C/nodes", node)

    async def ask(self, method: str, path: str, body: Any = None) -> Any:
        """Send a request; None while the master does not answer."""
        try:
            return await self._client.call(method, path, body)
        except ApiError:
            raise
        except (CliError, aiohttp.ClientError, OSError):
            return None

    async def move(self, machine: str) -> None:
        """Ask for a move, as soon as the machine is connected, without files of the move before."""

        async def is_accepted() -> bool:
            try:
                await self.ask("PUT", "/containers/C/machine", {"machine": machine})
            except ApiError as error:
                if not any(reason in str(error) for reason in NOT_YET):
                    raise
                return False
            return True

        await until(is_accepted, timeout=WAIT_S, what=f"the container may move to {machine}")

    async def shown(self) -> dict[str, Any] | None:
        found = await self.ask("GET", "/containers")
        return None if found is None else next(one for one in found["containers"] if one["tag"] == "C")

    def acknowledged(self) -> list[str]:
        try:
            return (self._shared / "acknowledged").read_text().split()
        except FileNotFoundError:
            return []

    async def writes(self) -> dict[str, Any]:
        """Wait until the container runs, moves no more, and writes; return what the master shows of it."""
        before = len(self.acknowledged())

        async def does() -> dict[str, Any] | None:
            found = await self.shown()
            settled = found is not None and found["state"] == "running" and not found["moving_to"]
            return found if settled and len(self.acknowledged()) > before + 20 else None

        return await until(does, timeout=WAIT_S, what="the container runs and writes")

    async def is_at(self, machine: str) -> None:
        """Wait until the container is placed at a machine; the master shows the former one for a while."""

        async def is_there() -> bool:
            found = await self.shown()
            return found is not None and found["machine"] == machine

        await until(is_there, timeout=WAIT_S, what=f"the container is at {machine}")

    async def other(self) -> str:
        """Return the machine where the container is not."""
        found = await self.shown()
        assert found is not None
        return "machine1" if found["machine"] == "machine0" else "machine0"

    def program(self, machine: str) -> Program:
        return self.engine.machines[int(machine.removeprefix("machine"))]

    def kill_containers(self) -> None:
        """Kill environments with their nodes, which outlive an environment that is killed alone."""
        for environment in self.engine.processes_of("rce_container.environment"):
            with contextlib.suppress(psutil.NoSuchProcess):
                nodes = environment.children(recursive=True)
                environment.kill()
                for node in nodes:
                    node.kill()

    def folder(self, machine: str) -> Path:
        return self.engine.folder / machine / "volumes" / "testUser" / "journal"

    async def check(self, promised: list[str]) -> None:
        """Check that what was acknowledged is in the only database that is left, and nothing ran twice."""
        found = await self.writes()
        machine = found["machine"]
        other = "machine1" if machine == "machine0" else "machine0"
        await until(lambda: not self.folder(other).exists(), timeout=WAIT_S, what="the former folder is gone")
        removed = self.engine.folder / other / "volumes" / ".removed"
        await until(
            lambda: not removed.exists() or not any(removed.iterdir()),
            timeout=WAIT_S,
            what="the former files are deleted",
        )
        with sqlite3.connect(self.folder(machine) / "rows.sqlite") as database:
            rows = {name for (name,) in database.execute("select name from rows")}
        database.close()
        lost = [name for name in promised if name not in rows]
        assert not lost, f"{len(lost)} of {len(promised)} acknowledged rows are lost"
        assert not (self._shared / "twice").exists(), "it ran twice at the same time"


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    nodes = tmp_path / "packages" / "own" / "nodes"
    nodes.mkdir(parents=True)
    (nodes / "rows.py").write_text(ROWS)
    (nodes.parent / "package.yaml").write_text("name: own\n")
    return tmp_path / "packages"


@asynccontextmanager
async def moved(packages: Path, **volume: Any) -> AsyncIterator[Moved]:
    shared = packages.parent / "shared"
    shared.mkdir()
    async with (
        running_engine(packages=packages, machines=2) as engine,
        ApiClient(engine.url, engine.token()) as client,
    ):
        world = Moved(engine, shared, client)
        await world.create(**volume)
        await world.writes()
        yield world


async def test_moves_and_drains_keep_every_row(packages: Path) -> None:
    async with moved(packages) as world:
        for _ in range(2):
            target = await world.other()
            await world.move(target)
            found = await world.writes()
            assert found["machine"] == target
            await world.check(world.acknowledged())
        for _ in range(2):
            target = await world.other()
            source = "machine1" if target == "machine0" else "machine0"
            await world.ask("PUT", f"/machines/{source}/drain")

            await world.is_at(target)
            await world.check(world.acknowledged())
            await world.ask("DELETE", f"/machines/{source}/drain")


VICTIMS: dict[str, Callable[[Moved, str, str], Program]] = {
    "master": lambda world, _, __: world.engine.master,
    "source": lambda world, source, _: world.program(source),
    "target": lambda world, _, target: world.program(target),
}


@pytest.mark.parametrize("victim", VICTIMS)
async def test_kills_at_any_moment_keep_every_row(packages: Path, victim: str) -> None:
    moments = random.Random(victim)
    async with moved(packages) as world:
        for moment in (0.0, *(moments.uniform(0.0, 1.5) for _ in range(2))):
            target = await world.other()
            source = "machine1" if target == "machine0" else "machine0"
            await world.move(target)
            await asyncio.sleep(moment)  # the moment of the fault
            program = VICTIMS[victim](world, source, target)
            await program.kill()
            await program.start()
            await world.check(world.acknowledged())


async def test_a_lost_machine_costs_what_came_after_the_snapshot(packages: Path) -> None:
    async with moved(packages, snapshots=5) as world:
        before = world.acknowledged()

        async def snapshot(after: float) -> float | None:
            found = await world.ask("GET", "/volumes")
            (volume,) = found["volumes"]
            assert volume["fault"] == ""
            taken = volume["snapshot"]
            return taken if taken is not None and taken > after else None

        first = await until(lambda: snapshot(0.0), timeout=WAIT_S, what="a snapshot")
        # The first one may have begun before the rows above were written; a later one has begun after them.
        await until(lambda: snapshot(first), timeout=WAIT_S, what="another snapshot")
        target = await world.other()
        source = "machine1" if target == "machine0" else "machine0"
        await world.program(source).kill()
        world.kill_containers()
        await world.is_at(target)
        await world.writes()
        with sqlite3.connect(world.folder(target) / "rows.sqlite") as database:
            assert database.execute("pragma integrity_check").fetchone() == ("ok",)
        database.close()
        assert world.folder(source).exists()
        await world.program(source).start()
        await world.check(before)
