"""Masters on loopback that find each other, ours and real ones."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from rce.ros.core import Core, Graph
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.settings import DiscoverySettings
from rce.ros.multimaster.sync import MasterSync, SyncSettings
from rce.ros.node import Node
from rce.ros.types import TypeRegistry
from support.ports import free_port
from support.processes import finish

STRING = "std_msgs/String"
FAST = 10.0
"""Heartbeats and questions per second in tests."""


def node(name: str, uri: str, types: TypeRegistry | None = None) -> Node:
    return Node(name, argv=[], master_uri=uri, types=types)


class DiscoveryNetwork:
    """Masters of one test share a multicast port that no other test uses."""

    def __init__(self) -> None:
        self.port = free_port()

    def settings(self, master_uri: str, **more: object) -> DiscoverySettings:
        values = {
            "master_uri": master_uri,
            "mcast_group": "226.0.0.0@127.0.0.1",
            "mcast_port": self.port,
            "rpc_port": free_port(),
            "heartbeat_hz": FAST,
            "rosmaster_hz": FAST,
        }
        return DiscoverySettings(**(values | more))  # type: ignore[arg-type]  # a test may give any setting

    @asynccontextmanager
    async def machine(
        self, master_uri: str | None = None, *, lists: SyncLists | None = None, **more: object
    ) -> AsyncIterator[Machine]:
        """A core (or the master at ``master_uri``) with discovery and synchronization."""
        if master_uri is not None:
            async with self._joined(master_uri, lists, more) as machine:
                yield machine
            return
        async with Core(port=0) as core, self._joined(core.uri, lists, more) as machine:
            machine.core = core
            yield machine

    @asynccontextmanager
    async def _joined(
        self, uri: str, lists: SyncLists | None, more: dict[str, object]
    ) -> AsyncIterator[Machine]:
        sync_more = {name: more.pop(name) for name in ("distinct_names", "namespaces") if name in more}
        settings = SyncSettings(uri, lists=lists or SyncLists(), **sync_more)  # type: ignore[arg-type]  # a test may give any setting
        async with Discovery(self.settings(uri, **more)) as discovery, MasterSync(settings) as sync:
            yield Machine(uri, discovery, sync)


class Machine:
    def __init__(self, uri: str, discovery: Discovery, sync: MasterSync) -> None:
        self.uri = uri
        self.discovery = discovery
        self.sync = sync
        self.core: Core | None = None

    @property
    def graph(self) -> Graph:
        assert self.core is not None
        return self.core.graph

    async def until_known(self, name: str, *, online: bool, timeout: float = 30) -> None:
        """Wait until the discovery has a master as online, or as offline."""
        async with asyncio.timeout(timeout):
            while (name, online) not in [(master.name, master.online) for master in self.discovery.masters]:
                await asyncio.sleep(0.02)

    async def until(self, condition: Callable[[Graph], bool], timeout: float = 20) -> None:
        assert self.core is not None
        await self.core.wait_until(condition, timeout=timeout)


def ros_environment(master_uri: str, home: Path) -> dict[str, str]:
    """What programs of a real ROS need; without this project's Python path."""
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    return kept | {
        "ROS_MASTER_URI": master_uri,
        "ROS_IP": "127.0.0.1",
        "PATH": "/usr/bin:/bin",
        "HOME": str(home),
    }


@asynccontextmanager
async def process(*argv: str, env: dict[str, str]) -> AsyncIterator[asyncio.subprocess.Process]:
    """A program, killed at the end. What it printed and nobody read is shown if the test fails."""
    started = await asyncio.create_subprocess_exec(
        *argv,
        env=env,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        yield started
    finally:
        output = await finish(started)
        print(*argv, output.decode(errors="replace"), sep="\n")  # noqa: T201 - pytest shows it


@asynccontextmanager
async def real_master(home: Path, port: int | None = None) -> AsyncIterator[str]:
    """A ``rosmaster --core``; yields its URI."""
    port = port or free_port()
    uri = f"http://127.0.0.1:{port}/"
    async with process("/usr/bin/rosmaster", "--core", "-p", str(port), env=ros_environment(uri, home)):
        async with asyncio.timeout(30):
            while not _answers(port):
                await asyncio.sleep(0.05)
        yield uri


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
