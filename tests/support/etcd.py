"""Real etcd: one member or several as processes, and a proxy that cuts connections at chosen moments."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import aiohttp

from rce.tls import Context
from rce_master.exceptions import StoreError
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.layout import MAX_OPERATIONS
from support.engine import until
from support.go_between import LOOPBACK, GoBetween
from support.ports import free_ports
from support.processes import finish, suspend

START_S = 120.0
OK = 200


class Member:
    """One member of a cluster."""

    def __init__(self, folder: Path, name: str, ports: tuple[int, int]) -> None:
        self.folder = folder
        self.name = name
        self.endpoint = f"{LOOPBACK}:{ports[0]}"
        self.peer = f"http://{LOOPBACK}:{ports[1]}"
        self.process: asyncio.subprocess.Process | None = None

    async def start(self, members: Sequence[Member], *options: str, scheme: str = "http") -> None:
        url = f"{scheme}://{self.endpoint}"
        with (self.folder / f"{self.name}.log").open("ab") as log:
            self.process = await asyncio.create_subprocess_exec(
                "etcd",
                *("--name", self.name, "--data-dir", str(self.folder / self.name)),
                *("--listen-client-urls", url, "--advertise-client-urls", url),
                *("--listen-peer-urls", self.peer, "--initial-advertise-peer-urls", self.peer),
                *("--initial-cluster", ",".join(f"{each.name}={each.peer}" for each in members)),
                *("--max-txn-ops", str(MAX_OPERATIONS), "--log-level", "error", *options),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def send(self, number: signal.Signals) -> None:
        assert self.process is not None
        if number is signal.SIGSTOP:
            suspend(self.process.pid)
        else:
            self.process.send_signal(number)

    async def end(self) -> None:
        if self.process is not None:
            await finish(self.process)
            self.process = None


class Cluster:
    """Members that run, the first of them first."""

    def __init__(self, members: Sequence[Member]) -> None:
        self.members = members

    @property
    def endpoints(self) -> list[str]:
        return [member.endpoint for member in self.members]

    @property
    def store(self) -> str:
        """The value of ``--store``."""
        return f"etcd://{','.join(self.endpoints)}"

    async def leader(self) -> Member:
        """Return the member that leads."""
        return await self.leader_of(self.members)

    async def set_alarm(self, *, on: bool) -> None:
        """Raise the alarm of a full database at the first member, or disarm it."""
        url = f"http://{self.endpoints[0]}/v3/maintenance/"
        async with aiohttp.ClientSession() as session:
            async with session.post(f"{url}status", json={}) as reply:
                member = (await reply.json())["header"]["member_id"]
            alarm = {"action": "ACTIVATE" if on else "DEACTIVATE", "memberID": member, "alarm": "NOSPACE"}
            async with session.post(f"{url}alarm", json=alarm) as reply:
                assert reply.status == OK, await reply.text()

    async def leader_of(self, members: Sequence[Member]) -> Member:
        """Return the member that leads; those asked must run."""
        return await until(lambda: _leader_of(members), timeout=START_S, what="a member of etcd leads")


@asynccontextmanager
async def cluster(
    folder: Path, count: int = 1, *options: str, tls: Context | None = None
) -> AsyncIterator[Cluster]:
    """Run a cluster until it is left; give it once it has a quorum."""
    folder.mkdir(exist_ok=True)
    ports = free_ports(2 * count)
    members = [Member(folder, f"m{i}", (ports[2 * i], ports[2 * i + 1])) for i in range(count)]
    made = Cluster(members)
    async with AsyncExitStack() as stack:
        for member in members:
            stack.push_async_callback(member.end)
            await member.start(members, *options, scheme="http" if tls is None else "https")
        async with EtcdClient(made.endpoints, tls=tls, attempt=5.0) as client:
            await until(lambda: _works(client), timeout=START_S, what="etcd has a quorum")
        yield made


async def _leader_of(members: Sequence[Member]) -> Member | None:
    async with aiohttp.ClientSession() as session:
        for member in members:
            url = f"http://{member.endpoint}/v3/maintenance/status"
            async with session.post(url, json={}) as reply:
                status = await reply.json()
            if status.get("leader") == status["header"]["member_id"]:
                return member
    return None


async def _works(client: EtcdClient) -> bool:
    with contextlib.suppress(StoreError):
        await client.get("/")
        return True
    return False


class CuttingProxy(GoBetween):
    """Passes requests on to a server; after :meth:`cut` it drops connections in place of answers.

    Attributes:
        cuts: How many answers were cut off.
    """

    def __init__(self, target: str) -> None:
        host, _, port = target.rpartition(":")
        super().__init__((host, int(port)))
        self._path, self._left = b"", 0
        self.cuts = 0

    def cut(self, path: str, count: int) -> None:
        """Let the server do the next requests for a path, and their clients get no answer."""
        self._path, self._left = path.encode(), count

    async def connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while request := await _message(reader):
            async with self.to_server() as (server_reader, server_writer):
                server_writer.write(request)
                answer = await _message(server_reader)
            if self._left and self._path in request:
                self._left -= 1
                self.cuts += 1
                return
            writer.write(answer)
            await writer.drain()


async def _message(reader: asyncio.StreamReader) -> bytes:
    """Read one HTTP message with a length or in chunks; empty at the end."""
    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.IncompleteReadError as error:
        if error.partial:
            raise
        return b""
    lowered = head.lower()
    if b"transfer-encoding: chunked" in lowered:
        body = b""
        while not body.endswith(b"0\r\n\r\n"):
            body += await reader.readline()
        return head + body
    _, _, rest = lowered.partition(b"content-length:")
    return head + await reader.readexactly(int(rest.split(b"\r\n")[0] or 0))
