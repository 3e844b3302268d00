"""``rce cluster`` on three machines whose services systemd runs: killed, renewed, rebooted, without power."""

from __future__ import annotations

import asyncio
import itertools
import json
import ssl
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from faults.machines import on_machine
from support.booted import SYSTEMD, Booted, booted
from support.engine import until
from support.networks import NetworkMachine, network

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("root", "systemd", "cgroups", "netns", "etcd"),
    pytest.mark.skipif(not SYSTEMD.exists(), reason="systemd is missing (Debian: systemd)"),
    pytest.mark.timeout(600),
]

BIN = Path(sys.executable).parent
RCE = BIN / "rce"
MACHINES = 3
TIMEOUT_S = 120.0
CERTIFICATES = "/var/lib/rce/certificates"
PASSWORD = "a long password"
PAUSE_S = 0.1
UNITS = ("rce-etcd", "rce-master")
FAILURES = (aiohttp.ClientError, TimeoutError, OSError, ValueError)


class Server:
    """A machine of the cluster, while it is on and while it is off."""

    def __init__(self, number: int, place: NetworkMachine, disk: Path) -> None:
        self._number, self._place, self._disk = number, place, disk
        self._power = AsyncExitStack()
        self.name, self.address = f"m{number}", place.address
        self.machine: Booted

    async def switch_on(self) -> None:
        self.machine = await self._power.enter_async_context(
            booted(self._number, network=self._place.namespace, disk=self._disk)
        )

    async def cut_power(self) -> None:
        await self._power.aclose()

    async def reboot(self) -> None:
        await self.machine.reboot()
        await self._power.aclose()
        await self.switch_on()

    async def rce(self, words: str, *, stdin: str = "") -> str:
        return await self.machine.run_soon(f"{RCE} {words}", stdin=stdin)

    async def status(self) -> dict[str, Any]:
        told = await self.machine.run_soon(f"{RCE} cluster status --json 2>&1", code=None)
        with suppress(ValueError):
            return dict(json.loads(told))
        return {"ok": False, "told": told}

    def pid(self, unit: str) -> int:
        return int(self.machine.run(f"systemctl show --value -p MainPID {unit}"))

    def log(self) -> str:
        units = " ".join(f"-u {unit}" for unit in UNITS)
        return self.machine.run(f"journalctl --no-pager -o short-precise {units} | tail -n 60", code=None)


@asynccontextmanager
async def servers(places: list[NetworkMachine], folder: Path) -> AsyncIterator[list[Server]]:
    with ExitStack() as disks:
        made = [
            Server(number, place, disks.enter_context(disk(folder / f"disk{number}")))
            for number, place in enumerate(places, 1)
        ]
        async with AsyncExitStack() as stack:
            for server in made:
                stack.push_async_callback(server.cut_power)
            await asyncio.gather(*(server.switch_on() for server in made))
            try:
                yield made
            except BaseException:
                for server in made:
                    print(f"--- {server.name}\n{server.log()}")  # noqa: T201
                raise


@contextmanager
def disk(path: Path) -> Iterator[Path]:
    """Make a disk, which may be in use at the end."""
    path.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", path], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", path], check=True)


class Writer:
    """A client that writes all the time, to the next master when one does not answer.

    Attributes:
        acknowledged: The robots of tokens that masters acknowledged, with the times of it.
    """

    def __init__(self, servers: list[Server], authority: str) -> None:
        self._urls = [f"https://{server.address}:9000/api/v1" for server in servers]
        self._tls = ssl.create_default_context(cadata=authority)
        self.acknowledged: dict[str, float] = {}

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self._run())
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _run(self) -> None:
        used = 0
        async with self._session(await self._token()) as session:
            for number in itertools.count():
                if not await self._is_made(session, self._urls[used % len(self._urls)], f"robot{number}"):
                    used += 1
                await asyncio.sleep(PAUSE_S)

    async def _is_made(self, session: aiohttp.ClientSession, url: str, robot: str) -> bool:
        with suppress(*FAILURES):
            async with session.post(f"{url}/robot-tokens", json={"robot": robot}) as reply:
                if reply.status == 201:
                    self.acknowledged[robot] = time.monotonic()
                    return True
        return False

    async def _token(self) -> str:
        return await until(self._log_in, timeout=TIMEOUT_S, what="a user logs in")

    async def _log_in(self) -> str:
        body = {"userID": "alice", "password": PASSWORD}
        for url in self._urls:
            with suppress(*FAILURES):
                async with self._session() as session, session.post(f"{url}/login", json=body) as reply:
                    return str((await reply.json()).get("token", ""))
        return ""

    def _session(self, token: str = "") -> aiohttp.ClientSession:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        connector = aiohttp.TCPConnector(ssl=self._tls)
        timeout = aiohttp.ClientTimeout(total=3.0)
        return aiohttp.ClientSession(connector=connector, headers=headers, timeout=timeout)

    async def wait(self, count: int = 3) -> None:
        """Wait until so many more writes are acknowledged."""
        wanted = len(self.acknowledged) + count
        await until(
            lambda: len(self.acknowledged) >= wanted, timeout=TIMEOUT_S, what="writes are acknowledged"
        )

    def longest_pause(self, start: float) -> float:
        """Return the longest time without an acknowledged write since a moment, seconds."""
        times = [start, *(at for at in self.acknowledged.values() if at > start), time.monotonic()]
        return max(after - before for before, after in itertools.pairwise(times))

    async def stored(self) -> set[str]:
        """Return the robots of all tokens."""

        async def read() -> set[str] | None:
            for url in self._urls:
                with suppress(*FAILURES):
                    async with (
                        self._session(await self._token()) as session,
                        session.get(f"{url}/robot-tokens") as reply,
                    ):
                        if reply.status == 200:
                            return {each["robot"] for each in (await reply.json())["tokens"]}
            return None

        return await until(read, timeout=TIMEOUT_S, what="a master tells the tokens")


async def make_cluster(made: list[Server]) -> None:
    """Make it as docs/how-to/cluster.md says, as an administrator whose umask hides new files."""
    first, *others = made
    for server in made:
        server.machine.let_enter(sys.base_prefix, str(BIN))
        secret = "umask 077; mkdir -p /etc/rce; cat >/etc/rce/secret"
        server.machine.run(secret, stdin="a secret of all machines, which is long")
    place = f"--address {first.address} --name {first.name}"
    told = await first.machine.run_soon(f"umask 077; {RCE} cluster init {place}")
    add = next(
        line.partition("rce ")[2] for line in told.splitlines() if line.startswith("next, add the first")
    )
    await first.rce(f"{add.replace('NAME', 'alice')} --password-stdin", stdin=f"{PASSWORD}\n")
    await first.machine.run_soon("systemctl start rce-master")
    for server in others:
        issue = f"certificate issue {server.name} --host {server.address} --certificates {CERTIFICATES}"
        await first.rce(issue)
        given = {f"{server.name}.pem": "engine.pem", f"{server.name}.key": "engine.key"}
        for source, target in {**given, **{name: name for name in ("authority.pem", "revoked.pem")}}.items():
            text = first.machine.run(f"cat {CERTIFICATES}/{source}")
            put = f"umask 077; mkdir -p {CERTIFICATES}; cat >{CERTIFICATES}/{target}"
            server.machine.run(put, stdin=text)
        join = f"cluster join {first.address} --address {server.address} --name {server.name}"
        await server.machine.run_soon(f"umask 077; {RCE} {join}")
    await first.machine.run_soon(f"{RCE} cluster init {place}")


async def whole(server: Server) -> dict[str, Any]:
    """Wait until a machine's status finds nothing to do; return it."""

    found: dict[str, Any] = {}

    async def look() -> dict[str, Any] | None:
        nonlocal found
        found = await server.status()
        roles = sorted(each["role"] for each in found.get("masters", ()))
        return found if found["ok"] and roles == ["leader", "standby", "standby"] else None

    try:
        return await until(look, timeout=TIMEOUT_S, what="the cluster is whole")
    except AssertionError as error:
        raise AssertionError(f"{error}: {found}") from error


async def leader(made: list[Server]) -> Server:
    """Return the machine whose master leads, once the cluster is whole."""
    found = await whole(made[0])
    (name,) = [each["name"] for each in found["masters"] if each["role"] == "leader"]
    return next(server for server in made if server.name == name)


async def test_cluster_outlives_kills_renewals_and_reboots(folder: Path) -> None:
    with network(MACHINES + 1) as places, on_machine(places[-1]):
        async with servers(places[:-1], folder) as made:
            await make_cluster(made)
            writer = Writer(made, made[0].machine.run(f"cat {CERTIFICATES}/authority.pem"))
            async with writer.running():
                await check_services(made)
                await check_kills(made, writer)
                await check_renewal(made, writer)
                await check_reboot(made, writer)
                await check_power(made, writer)
            assert set(writer.acknowledged) <= await writer.stored()


async def check_services(made: list[Server]) -> None:
    """They run as their user, and each master knows all members of etcd."""
    await whole(made[0])
    for server in made:
        for unit in UNITS:
            assert server.machine.run(f"stat -c %U /proc/{server.pid(unit)}").strip() == "rce"
            assert server.machine.run(f"systemctl is-enabled {unit}").strip() == "enabled"
    command = made[0].machine.run(f"tr '\\0' ' ' </proc/{made[0].pid('rce-master')}/cmdline")
    assert all(f"{server.address}:2379" in command for server in made), command


async def check_kills(made: list[Server], writer: Writer) -> None:
    """Both programs of the leading machine are killed; systemd starts them again."""
    one = await leader(made)
    before = {unit: one.pid(unit) for unit in UNITS}
    one.machine.run(f"kill -KILL {' '.join(map(str, before.values()))}")

    def is_back(unit: str) -> bool:
        return one.pid(unit) not in (0, before[unit])

    for unit in UNITS:
        await until(partial(is_back, unit), timeout=TIMEOUT_S, what=f"{unit} is back")
    await whole(one)
    await writer.wait()


async def check_renewal(made: list[Server], writer: Writer) -> None:
    """A certificate that root renews is read by the programs of their user, also at a new start."""
    first = made[0]
    await first.rce(f"certificate issue engine --certificates {CERTIFICATES}")
    await first.rce(f"certificate issue lost --host 10.77.0.99 --certificates {CERTIFICATES}")
    await first.rce(f"certificate revoke lost --certificates {CERTIFICATES}")
    await first.machine.run_soon("systemctl restart rce-etcd rce-master")
    await whole(first)
    await writer.wait()


async def check_reboot(made: list[Server], writer: Writer) -> None:
    """The leading machine reboots in order: it hands over, stops whole, and comes back by itself."""
    one = await leader(made)
    await one.machine.run_soon("systemctl stop rce-master rce-etcd")
    for unit in UNITS:
        assert one.machine.run(f"systemctl show --value -p Result {unit}").strip() == "success"
    ended = [int(one.machine.run(f"systemctl show --value -p {at}")) for at in stop_times()]
    assert ended[0] <= ended[1], "etcd was stopped while the master needed it"
    one.machine.run("systemctl start rce-etcd rce-master")
    one = await leader(made)
    since = time.monotonic()
    await one.reboot()
    await whole(one)
    pause = writer.longest_pause(since)
    print(f"longest time without a write while the leading machine rebooted: {pause:.2f} s")  # noqa: T201
    await writer.wait()


def stop_times() -> tuple[str, str]:
    """Return the properties that tell when the master had ended, and when etcd was told to end."""
    return "InactiveEnterTimestampMonotonic rce-master", "ActiveExitTimestampMonotonic rce-etcd"


async def check_power(made: list[Server], writer: Writer) -> None:
    """All machines lose power at once, and come back."""
    for server in made:
        await server.cut_power()
    await asyncio.gather(*(server.switch_on() for server in made))
    await whole(made[-1])
    await writer.wait()
