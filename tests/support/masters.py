"""Several masters on one etcd as processes, and users who write at whichever of them leads."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import AsyncIterator, Awaitable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

from rce_master.leadership.core import STANDBY_HEADER
from support.engine import Program, until
from support.master_program import environment
from support.ports import free_ports

LOOPBACK = "127.0.0.1"
DEV_USER = "testUser"
MAX_WRITES = 120
"""Of one writer in one test: a user may have 2000 tokens."""
_FAILURES = (aiohttp.ClientError, TimeoutError, ConnectionError)


class MasterProcess(Program):
    """One of several masters."""

    def __init__(self, folder: Path, name: str, store: str, lease: float) -> None:
        self.http_port, self.control_port = free_ports(2)
        argv = [
            *(sys.executable, "-m", "rce_master", "--dev", "--store", store, "--lease", str(lease)),
            *("--machine", name, "--state-dir", str(folder / name)),
            *("--http-port", str(self.http_port), "--control-port", str(self.control_port)),
        ]
        super().__init__(name, argv, environment(folder), folder)

    @property
    def url(self) -> str:
        return f"http://{LOOPBACK}:{self.http_port}/"

    def send(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)

    async def health(self) -> dict[str, Any]:
        """Return the answer of ``/healthz`` with its status; empty if there is none."""
        timeout = aiohttp.ClientTimeout(total=2.0)
        with contextlib.suppress(*_FAILURES):
            async with (
                aiohttp.ClientSession(timeout=timeout) as session,
                session.get(f"{self.url}healthz") as reply,
            ):
                return {**await reply.json(), "code": reply.status}
        return {}


class Masters:
    """Masters that run.

    Attributes:
        acknowledged: The robots whose tokens a master said that it made.
    """

    def __init__(self, all_: list[MasterProcess]) -> None:
        self.all = all_
        self.acknowledged: list[str] = []
        self.token = ""
        self._next = 0

    async def leader(self, *, but: MasterProcess | None = None) -> MasterProcess:
        """Return the master that leads and serves, when there is one."""
        return await until(lambda: self._leader(but), timeout=120, what="a master leads")

    async def _leader(self, but: MasterProcess | None) -> MasterProcess | None:
        for master in self.all:
            if master is not but and master.running:
                found = await master.health()
                if found.get("role") == "leader" and found["ready"]:
                    return master
        return None

    async def log_in(self) -> None:
        leader = await self.leader()
        async with aiohttp.ClientSession() as session:
            body = {"userID": DEV_USER, "password": DEV_USER}
            async with session.post(f"{leader.url}api/v1/login", json=body) as reply:
                assert reply.status == 200, await reply.text()
                self.token = (await reply.json())["token"]

    def session(self, timeout: float = 3.0) -> aiohttp.ClientSession:
        return aiohttp.ClientSession(
            headers={"Authorization": f"Bearer {self.token}"}, timeout=aiohttp.ClientTimeout(total=timeout)
        )

    async def ask(self, method: str, url: str, **options: Any) -> tuple[int, str]:
        """Ask a master; repeat what was not done because no master led at that moment."""

        async def answer() -> tuple[int, str] | None:
            async with (
                self.session(120.0) as session,
                session.request(method, url, **options) as reply,
            ):
                return None if STANDBY_HEADER in reply.headers else (reply.status, await reply.text())

        return await until(answer, timeout=120, what=f"a leading master answers {method} {url}")

    @asynccontextmanager
    async def under_load(self, writers: int = 3) -> AsyncIterator[None]:
        """Make tokens of robots all the time, each of its own name, at the master that answers."""
        tasks = [asyncio.create_task(self._write(number)) for number in range(writers)]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            for task in tasks:
                with contextlib.suppress(asyncio.CancelledError):
                    await task

    async def wait_for_writes(self, count: int = 5) -> None:
        """Wait until so many more writes are acknowledged."""
        wanted = len(self.acknowledged) + count
        await until(
            lambda: len(self.acknowledged) >= wanted, timeout=120, what=f"{count} writes are acknowledged"
        )

    async def _write(self, writer: int) -> None:
        used, made = writer, 0
        async with self.session() as session:
            while made < MAX_WRITES:
                self._next += 1
                robot = f"robot_{writer}_{self._next}"
                url = self.all[used % len(self.all)].url
                try:
                    async with session.post(f"{url}api/v1/robot-tokens", json={"robot": robot}) as reply:
                        if reply.status == 201:
                            self.acknowledged.append(robot)
                            made += 1
                        else:
                            # 502: a stand-by does not know whether the leader has done it.
                            assert reply.status in {502, 503}, (reply.status, await reply.text())
                            used += 1
                except _FAILURES:
                    used += 1
                await asyncio.sleep(0.1)

    async def stored(self) -> set[str]:
        """Return the robots that have tokens."""
        leader = await self.leader()
        url = f"{leader.url}api/v1/robot-tokens"
        async with self.session(30.0) as session, session.get(url) as reply:
            assert reply.status == 200, await reply.text()
            return {token["robot"] for token in (await reply.json())["tokens"]}

    async def check_nothing_is_lost(self) -> None:
        assert set(self.acknowledged) - await self.stored() == set()


@asynccontextmanager
async def masters(folder: Path, store: str, *, count: int = 3, lease: float = 3.0) -> AsyncIterator[Masters]:
    """Run masters until they are left; give them once one of them leads."""
    folder.mkdir(exist_ok=True)
    made = Masters([MasterProcess(folder, f"master{number}", store, lease) for number in range(count)])
    async with AsyncExitStack() as stack:
        starts: list[Awaitable[None]] = []
        for master in made.all:
            stack.push_async_callback(_end, master)
            starts.append(master.start(ready="rce-master stand-by: "))
        await asyncio.gather(*starts)
        await made.log_in()
        yield made


async def _end(master: MasterProcess) -> None:
    if master.running:
        with contextlib.suppress(ProcessLookupError):
            master.send(signal.SIGCONT)
        assert await master.stop() == 0, master.output()
