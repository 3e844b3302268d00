"""A robot task set ends, hangs or is drained: how long its robots take until they are at another one.

They have all that they had there.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from time import perf_counter
from typing import Any

import aiohttp
import psutil

from benchmarks.engine import BIN, free_ports
from rce.supervision.process import Child
from rce_client import Connection

CONTAINER, STRING = "planner", "std_msgs/String"
TARGET_S = 2.0
HUNG_TARGET_S = 20.0
"""A hung one ends no connection: others refuse its robots until the master misses it, for up to 13 s."""
WAIT_S = 120.0
DRAINED, HUNG = "drained (rce drain)", "hung (SIGSTOP)"
WAYS = {
    "killed (-9)": signal.SIGKILL,
    "stopped (SIGTERM)": signal.SIGTERM,
    DRAINED: None,
    HUNG: signal.SIGSTOP,
}
"""How a robot task set ends; None: it runs on, and takes no robots."""


class _Parts:
    """A master, a container task set, and robot task sets that come and go."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._http, self._control = free_ports(2)
        self._readers: list[asyncio.Task[None]] = []
        self.children: list[Child] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._http}/"

    async def start(self, program: str, *options: object) -> Child:
        """Start a program, and wait until it is ready."""
        argv = [str(BIN / program), *map(str, options), "--control-port", str(self._control), "--dev"]
        env = {"XDG_RUNTIME_DIR": str(self._folder), "RCE_SECRET": "of a benchmark"}
        child = await Child.start(program, argv, env={**os.environ, **env})
        self.children.append(child)
        async for line in child.lines():
            if " ready: " in line:
                self._readers.append(asyncio.create_task(_read(child)))
                return child
        raise RuntimeError(f"{program} did not start")

    async def robots(self) -> Child:
        """Start a robot task set."""
        ws, link = free_ports(2)
        return await self.start("rce-robot", "127.0.0.1", "--ws-port", ws, "--link-port", link)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        state = self._folder / "state"
        try:
            await self.start("rce-master", "--http-port", self._http, "--state-dir", state / "master")
            (port,) = free_ports(1)
            options = ("--link-port", port, "--state-dir", state / "container", "--runtime", "process")
            await self.start("rce-container", "127.0.0.1", *options)
            yield
        finally:
            for child in reversed(self.children):
                await child.stop(timeout=60)
            await asyncio.gather(*self._readers)


class _Api:
    """The master's REST API, for an administrator."""

    def __init__(self, session: aiohttp.ClientSession) -> None:
        self._session = session

    @classmethod
    @contextlib.asynccontextmanager
    async def of(cls, url: str) -> AsyncIterator[_Api]:
        """Log in at a master."""
        async with aiohttp.ClientSession(f"{url}api/v1/", raise_for_status=True) as session:
            async with session.post("login", json={"userID": "testUser", "password": "testUser"}) as reply:
                session.headers["Authorization"] = f"Bearer {(await reply.json())['token']}"
            yield cls(session)

    async def robot_task_set(self) -> str:
        """Return the name of the only robot task set that is connected."""
        while True:
            async with self._session.get("machines") as reply:
                machines = (await reply.json())["machines"]
            found = [one["process"] for one in machines if one["kind"] == "robot" and one["connected"]]
            if len(found) == 1:
                return str(found[0])
            await asyncio.sleep(0.1)  # the master has not noticed yet that a former one ended

    async def drain(self, name: str) -> None:
        """Give a task set no more robots, and send away those that it has."""
        async with self._session.put(f"machines/{name}/drain"):
            pass


async def _read(child: Child) -> None:
    async for _ in child.lines():
        pass


async def run(*, robots: int, passes: int) -> list[dict[str, Any]]:
    """Make all robots leave their robot task set for an empty one in each way; one row for each time."""
    folder = Path(tempfile.mkdtemp(prefix="rce-bench-", dir="/tmp"))
    parts = _Parts(folder)
    rows = []
    try:
        async with parts.running(), contextlib.AsyncExitStack() as stack:
            there = await parts.robots()
            fleet = [await _join(stack, parts.url, number) for number in range(robots)]
            await _all_active(fleet)
            api = await stack.enter_async_context(_Api.of(parts.url))
            for way, number in WAYS.items():
                for _ in range(passes):
                    name = await api.robot_task_set()
                    other = await parts.robots()
                    processes = [psutil.Process(one.pid) for one in parts.children if one is not there]
                    del parts.children[parts.children.index(there)]
                    before, begin = _cpu(processes), perf_counter()
                    if number is None:
                        await api.drain(name)
                    else:
                        os.kill(there.pid, number)
                    await asyncio.gather(*(robot.lost.wait() for robot in fleet))
                    await _all_active(fleet)
                    seconds = perf_counter() - begin
                    rows.append(
                        _row(way, robots, seconds, _cpu(processes) - before, len(os.sched_getaffinity(0)))
                    )
                    if number is signal.SIGSTOP:
                        os.kill(there.pid, signal.SIGKILL)  # it hears no SIGTERM
                    await there.stop(timeout=60)
                    for robot in fleet:
                        robot.lost.clear()
                    there = other
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return rows


def _row(way: str, robots: int, seconds: float, cpu_s: float, cores: int) -> dict[str, Any]:
    return {
        "robot task set": way,
        "robots": robots,
        "seconds until all are elsewhere": round(seconds, 2),
        "target": HUNG_TARGET_S if way == HUNG else TARGET_S,
        "CPU seconds of engine": round(cpu_s, 2),
        "load": round(os.getloadavg()[0], 1),
        "cores": cores,
    }


class _Robot:
    """A robot whose two interfaces are joined with the container."""

    def __init__(self, url: str, number: int) -> None:
        self.name = f"mover{number}"
        self.lost = asyncio.Event()
        self.connection = Connection(
            url, "testUser", "testUser", self.name, on_state=lambda state, _: self._note(state.value)
        )
        self.interfaces: list[Any] = []

    def _note(self, state: str) -> None:
        if state == "lost":
            self.lost.set()

    async def wire(self, *, first: bool) -> None:
        """Make the interfaces and connections."""
        robot = self.connection
        if first:
            await robot.create_container(CONTAINER)
        for tag, inside in (("out", "PublisherInterface"), ("in", "SubscriberInterface")):
            at = f"{self.name}_{tag}"
            await robot.add_interface(CONTAINER, at, inside, STRING, addr=f"/{self.name}/{tag}")
            if tag == "out":
                self.interfaces.append(await robot.publisher(tag, STRING))
            else:
                self.interfaces.append(await robot.subscriber(tag, STRING, lambda _: None))
            await robot.connect(f"{self.name}/{tag}", f"{CONTAINER}/{at}")


async def _join(stack: contextlib.AsyncExitStack, url: str, number: int) -> _Robot:
    robot = _Robot(url, number)
    await stack.enter_async_context(robot.connection)
    await robot.wire(first=not number)
    return robot


async def _all_active(fleet: list[_Robot]) -> None:
    await asyncio.gather(*(one.wait_active(WAIT_S) for robot in fleet for one in robot.interfaces))


def _cpu(processes: list[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes)
