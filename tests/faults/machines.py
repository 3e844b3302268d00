"""The machines of the fault suite: network namespaces with a member of etcd and a master each, and others."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import aiohttp
from support.engine import Program, until
from support.networks import NetworkMachine, network

from rce.config.store_address import ETCD_PORT

LEASE_S = 3.0
MASTERS = 3
HTTP_PORT, CONTROL_PORT, PEER_PORT = 9000, 8080, 2380
SECRET = "a secret for the tests"
PATIENCE_S = 120.0
REACH_S = 0.5
"""How long a TCP connection may take over a network that is whole."""
_CLONE_NEWNET = 0x40000000
_ETCD_OPTIONS = (
    *("--max-txn-ops", "4096", "--max-request-bytes", "16777216", "--pre-vote", "--log-level", "error"),
    *("--initial-cluster-token", "faults"),
)
_FAILURES = (aiohttp.ClientError, TimeoutError, OSError, ValueError)


class Machine:
    """A machine with a member of etcd and a master.

    Attributes:
        etcd_options: More options of the member, from its next start on.
        etcd_launcher: The program, and its arguments, that starts the member.
        master_launcher: The program, and its arguments, that starts the master.
        master_state: The state folder of the master, from its next start on; None: the usual one.
        master_env: More variables of the master's environment, from its next start on.
        store: The address of the master's store, from its next start on; empty: the usual one.
    """

    def __init__(self, place: NetworkMachine, number: int, folder: Path) -> None:
        self.place = place
        self.name = f"m{number}"
        self.data = folder / self.name / "etcd"
        self.data.mkdir(parents=True)
        self.etcd_options: tuple[str, ...] = ()
        self.etcd_launcher: tuple[str, ...] = ()
        self.master_launcher: tuple[str, ...] = ()
        self.master_state: Path | None = None
        self.master_env: Mapping[str, str] = {}
        self.store = ""
        self.cluster_state = "new"
        self.env = environment(folder)
        self.member = Program(f"etcd-{self.name}", [], self.env, folder)
        self.master = Program(f"master-{self.name}", [], self.env, folder)

    @property
    def address(self) -> str:
        return self.place.address

    @property
    def url(self) -> str:
        """Of the master's HTTP server."""
        return f"http://{self.address}:{HTTP_PORT}/"

    @property
    def etcd(self) -> str:
        """Of the member, for clients."""
        return f"{self.address}:{ETCD_PORT}"

    @property
    def state(self) -> Path:
        """The state folder of the master."""
        return self.master_state or self.data.parent / "master"

    async def start_etcd(self, machines: list[Machine]) -> None:
        """Start the member."""
        clients, peers = f"http://{self.etcd}", f"http://{self.address}:{PEER_PORT}"
        members = ",".join(f"{each.name}=http://{each.address}:{PEER_PORT}" for each in machines)
        self.member.argv = [
            *self.place.prefix,
            *("/bin/sh", "-c", 'echo "etcd starts"; exec "$@"', self.name),
            *(*self.etcd_launcher, "etcd", "--name", self.name),
            *("--data-dir", str(self.data / "data"), "--initial-cluster", members),
            *("--listen-client-urls", clients, "--advertise-client-urls", clients),
            *("--listen-peer-urls", peers, "--initial-advertise-peer-urls", peers),
            *("--initial-cluster-state", self.cluster_state, *_ETCD_OPTIONS, *self.etcd_options),
        ]
        await self.member.start(ready="etcd starts")

    async def start_master(self, store: str) -> None:
        """Start the master, and wait until it stands by."""
        self.master.argv = [
            *(
                *self.place.prefix,
                *self.master_launcher,
                sys.executable,
                "-m",
                "rce_master",
                "--dev",
                "--store",
                store,
            ),
            *("--lease", str(LEASE_S), "--machine", self.name, "--bind", "0.0.0.0"),
            *("--state-dir", str(self.state)),
        ]
        self.master.env = {**self.env, **self.master_env}
        await self.master.start(ready="rce-master stand-by: ", timeout=PATIENCE_S)

    async def health(self) -> dict[str, Any]:
        """Return the answer of ``/healthz`` with its status; empty if there is none."""
        return await fetch(f"{self.url}healthz")

    async def leads_etcd(self) -> bool:
        """Return whether its member leads."""
        found = await fetch(f"http://{self.etcd}/v3/maintenance/status", post=True)
        return bool(found) and found.get("leader") == found.get("header", {}).get("member_id")


class Cluster:
    """The machines.

    Attributes:
        machines: Those with a master.
        client: The machine of robots and of other clients.
        server: The machine of the task sets.
    """

    def __init__(self, places: list[NetworkMachine], folder: Path) -> None:
        *masters, self.server, self.client = places
        self.folder = folder
        self.machines = [Machine(place, number, folder) for number, place in enumerate(masters, 1)]

    def store_of(self, machine: Machine) -> str:
        """Return the address of the store for a master: its own member first."""
        others = [each.etcd for each in self.machines if each is not machine]
        return f"etcd://{','.join([machine.etcd, *others])}"

    async def start_master(self, machine: Machine) -> None:
        """Start a master."""
        await machine.start_master(machine.store or self.store_of(machine))

    async def start(self) -> None:
        """Start all members and all masters."""
        for machine in self.machines:
            await machine.start_etcd(self.machines)
        await asyncio.gather(*map(self.start_master, self.machines))

    async def leader(self, *, but: Machine | None = None) -> Machine:
        """Return the machine whose master leads and serves."""
        return await until(lambda: self._leader(but), timeout=PATIENCE_S, what="a master leads")

    async def _leader(self, but: Machine | None) -> Machine | None:
        async def asked(machine: Machine) -> Machine | None:
            found = await machine.health()
            return machine if found.get("role") == "leader" and found["ready"] else None

        running = [each for each in self.machines if each is not but and each.master.running]
        tasks = [asyncio.create_task(asked(each)) for each in running]
        try:
            for answer in asyncio.as_completed(tasks):  # nothing waits for one that hangs
                if (leader := await answer) is not None:
                    return leader
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return None

    async def etcd_leader(self) -> Machine:
        """Return the machine whose member of etcd leads."""
        return await until(self._etcd_leader, timeout=PATIENCE_S, what="a member of etcd leads")

    async def _etcd_leader(self) -> Machine | None:
        for machine in self.machines:
            if machine.member.running and await machine.leads_etcd():
                return machine
        return None

    async def repair(self) -> None:
        """Start what does not run, and wait until all members and all masters answer again."""
        for machine in self.machines:
            if not machine.member.running:
                await machine.start_etcd(self.machines)
        for machine in self.machines:
            if not machine.master.running:
                await self.start_master(machine)
        await until(self._is_whole, timeout=PATIENCE_S, what="one master leads, and the others say which")

    async def _is_whole(self) -> bool:
        told = [await machine.health() for machine in self.machines]
        if sorted(each.get("role", "") for each in told) != ["leader", "standby", "standby"]:
            return False
        members = [await fetch(f"http://{machine.etcd}/health") for machine in self.machines]
        healthy = all(each.get("health") == "true" for each in members)
        return healthy and len({(each["leader"], each["term"]) for each in told}) == 1


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of the programs."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    return kept | {"RCE_SECRET": SECRET, "PYTHONUNBUFFERED": "1", "XDG_RUNTIME_DIR": str(folder)}


async def fetch(url: str, *, post: bool = False) -> dict[str, Any]:
    """Return an answer in JSON with its status as ``code``; empty if there is none within 2 s."""
    with contextlib.suppress(*_FAILURES):
        async with (
            aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=2.0)) as session,
            session.request("POST" if post else "GET", url, data="{}" if post else None) as reply,
        ):
            return {**await reply.json(content_type=None), "code": reply.status}
    return {}


async def is_reached(machine: Machine) -> bool:
    """Return whether the HTTP server of a master can be reached."""
    try:
        async with asyncio.timeout(REACH_S):
            _, writer = await asyncio.open_connection(machine.address, HTTP_PORT)
    except OSError:  # a time-out is one
        return False
    writer.close()
    return True


@asynccontextmanager
async def cluster(folder: Path) -> AsyncIterator[Cluster]:
    """Make the machines; what runs on them ends with them.

    This process is on the client's machine meanwhile.
    """
    with network(MASTERS + 2) as places:
        made = Cluster(places, folder)
        with on_machine(made.client):
            try:
                yield made
            finally:
                await _end(made)


async def _end(made: Cluster) -> None:
    async with AsyncExitStack() as stack:
        for machine in made.machines:
            for program in (machine.member, machine.master):
                if program.running:
                    stack.push_async_callback(program.kill)


@contextmanager
def on_machine(place: NetworkMachine) -> Iterator[None]:
    """Let this thread, and the programs that it starts, be on a machine: its sockets use that network."""
    own = os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    there = os.open(f"/run/netns/{place.namespace}", os.O_RDONLY | os.O_CLOEXEC)
    try:
        _enter(there)
        try:
            yield
        finally:
            _enter(own)
    finally:
        os.close(there)
        os.close(own)


def _enter(namespace: int) -> None:
    if ctypes.CDLL(None, use_errno=True).setns(namespace, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def send(program: Program, number: signal.Signals) -> None:
    """Send a signal to a program."""
    assert program.process is not None
    program.process.send_signal(number)
