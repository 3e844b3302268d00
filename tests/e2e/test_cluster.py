"""``rce cluster`` on machines that are network namespaces: one is lost for good, and replaced."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shlex
import shutil
import sys
import tarfile
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support.engine import Program, until
from support.networks import NetworkMachine, network
from support.processes import run_to_end

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("root", "netns", "etcd"),
    pytest.mark.timeout(600),
    pytest.mark.asyncio,
]

BIN = Path(sys.executable).parent
SECRET = "a secret of all machines"
START_S = 240.0
USER = "alice"
PASSWORD = "a long password"
WRITER = """
import asyncio, ssl, sys
import aiohttp

async def main(authority, password, *urls):
    tls = ssl.create_default_context(cafile=authority)
    timeout = aiohttp.ClientTimeout(total=5)
    number = 0
    token = ""
    async with aiohttp.ClientSession(timeout=timeout) as session:
        while True:
            url = urls[number % len(urls)]
            number += 1
            try:
                if not token:
                    body = {"userID": "alice", "password": password}
                    async with session.post(url + "api/v1/login", json=body, ssl=tls) as reply:
                        token = (await reply.json()).get("token", "")
                    continue
                headers = {"Authorization": "Bearer " + token}
                body = {"robot": f"robot{number}"}
                async with session.post(
                    url + "api/v1/robot-tokens", json=body, headers=headers, ssl=tls
                ) as reply:
                    if reply.status == 201:
                        print(f"acknowledged robot{number}", flush=True)
                    else:
                        print(url, reply.status, (await reply.text())[:200], flush=True)
            except (aiohttp.ClientError, TimeoutError, OSError) as error:
                print(url, repr(error), flush=True)
            await asyncio.sleep(0.2)

asyncio.run(main(*sys.argv[1:]))
"""
LISTING = """
import asyncio, json, ssl, sys
import aiohttp

async def main(authority, password, url):
    tls = ssl.create_default_context(cafile=authority)
    async with aiohttp.ClientSession() as session:
        body = {"userID": "alice", "password": password}
        while True:  # 503: it does not know the new leader yet
            async with session.post(url + "api/v1/login", json=body, ssl=tls) as reply:
                login = await reply.json()
                if reply.status != 503:
                    break
            await asyncio.sleep(0.2)
        headers = {"Authorization": "Bearer " + login["token"]}
        async with session.get(url + "api/v1/robot-tokens", headers=headers, ssl=tls) as reply:
            print(json.dumps([token["robot"] for token in (await reply.json())["tokens"]]))

asyncio.run(main(*sys.argv[1:]))
"""


class Host:
    """A machine of the cluster, its folder and its programs."""

    def __init__(self, machine: NetworkMachine, folder: Path, name: str) -> None:
        self.machine = machine
        self.name = name
        self.folder = folder / name
        self.folder.mkdir()
        (self.folder / "secret").write_text(SECRET)
        (self.folder / "secret").chmod(0o600)
        self.state = self.folder / "state"
        env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
        self.env = env | {"XDG_RUNTIME_DIR": str(self.folder), "HOME": str(self.folder)}
        self.etcd: Program | None = None
        self.master: Program | None = None

    @property
    def url(self) -> str:
        return f"https://{self.machine.address}:9000/"

    def program(self, name: str, *words: str) -> Program:
        return Program(f"{self.name}-{name}", [*self.machine.prefix, *words], self.env, self.folder)

    async def run(self, *words: str, given: str = "") -> tuple[int, str]:
        return await run_to_end(*self.machine.prefix, *words, env=self.env, text=given)

    async def rce(self, *words: str, given: str = "") -> tuple[int, str]:
        return await self.run(str(BIN / "rce"), *words, given=given)

    def cluster_words(self, command: str, *words: str) -> list[str]:
        place = ("--address", self.machine.address, "--name", self.name, "--state-dir", str(self.state))
        return ["cluster", command, *words, *place, "--foreground"]

    async def start_etcd(self, command: str, *words: str) -> None:
        self.etcd = self.program("etcd", str(BIN / "rce"), *self.cluster_words(command, *words))
        await self.etcd.start(ready="etcd ready: ", timeout=START_S)

    async def start_master(self) -> None:
        """Start the master as the command that started etcd says."""
        assert self.etcd is not None
        told = next(
            line.partition(": ")[2]
            for line in self.etcd.output().splitlines()
            if line.startswith("run the master: ")
        )
        _, *words = shlex.split(told)
        secret = ("--secret-file", str(self.folder / "secret"))
        self.master = self.program("master", str(BIN / "rce-master"), *words, *secret)
        await self.master.start(ready="rce-master stand-by: ", timeout=START_S)

    async def status(self) -> dict[str, Any]:
        _, output = await self.rce("cluster", "status", "--json", "--state-dir", str(self.state))
        try:
            return dict(json.loads(output))
        except ValueError:
            return {"ok": False, "output": output}

    async def lose(self) -> None:
        """Pull the cable, and end everything on it."""
        self.machine.unplug()
        for program in (self.master, self.etcd):
            assert program is not None
            await program.kill()

    def show(self) -> None:
        """Print what its programs have said, for the report of a test that failed."""
        for log in sorted(self.folder.glob("*.log")):
            print(f"--- {log.name}\n{log.read_text(errors='replace')[-20_000:]}")  # noqa: T201 - pytest shows it

    async def end(self) -> None:
        for program in (self.master, self.etcd):
            if program is not None and program.running:
                await program.stop()


@asynccontextmanager
async def hosts(folder: Path, count: int) -> AsyncIterator[list[Host]]:
    with network(count) as machines:
        made = [Host(machine, folder, f"m{index + 1}") for index, machine in enumerate(machines)]
        async with AsyncExitStack() as stack:
            for host in made:
                stack.push_async_callback(host.end)
            try:
                yield made
            except AssertionError:
                for host in made:
                    host.show()
                raise


async def give_certificate(first: Host, other: Host) -> None:
    """Issue a certificate on the first machine and copy it."""
    source = first.state / "certificates"
    place = ("--host", other.machine.address, "--certificates", str(source))
    code, output = await first.rce("certificate", "issue", other.name, *place)
    assert code == 0, output
    target = other.state / "certificates"
    target.mkdir(parents=True, mode=0o700)
    for suffix in ("pem", "key"):
        shutil.copy(source / f"{other.name}.{suffix}", target / f"engine.{suffix}")
    shutil.copy(source / "authority.pem", target / "authority.pem")


def acknowledged(writer: Program) -> list[str]:
    return [line.split()[1] for line in writer.output().splitlines() if line.startswith("acknowledged ")]


async def wait_for_writes(writer: Program, count: int = 3) -> None:
    wanted = len(acknowledged(writer)) + count
    await until(lambda: len(acknowledged(writer)) >= wanted, timeout=START_S, what="writes are acknowledged")


async def wait_until_whole(host: Host, names: set[str]) -> dict[str, Any]:
    """Wait until a machine's status finds nothing to do, and the members are these."""

    async def look() -> dict[str, Any] | None:
        found = await host.status()
        is_whole = found["ok"] and {each["name"] for each in found["members"]} == names
        return (
            found
            if is_whole and {each["role"] for each in found["masters"]} == {"leader", "standby"}
            else None
        )

    return await until(look, timeout=START_S, what=f"{names} are a cluster")


async def test_lost_machine_is_replaced(folder: Path) -> None:
    """The state is there, and writes are acknowledged all the time but for the change of the lead."""
    async with hosts(folder, 4) as (one, two, three, four):
        await one.start_etcd("init")
        store = f"etcds://{one.machine.address}:2379"
        code, output = await one.rce(
            *("user", "add", USER, "--admin", "--password-stdin"),
            *("--state-dir", str(one.state), "--store", store),
            given=PASSWORD,
        )
        assert code == 0, output
        await one.start_master()
        assert "join two more" in (await one.rce("cluster", "status", "--state-dir", str(one.state)))[1]
        for host in (two, three):
            await give_certificate(one, host)
            await host.start_etcd("join", one.machine.address)
            await host.start_master()
        assert "two machines cannot be highly available" in two.etcd.output()  # type: ignore[union-attr]
        await wait_until_whole(one, {"m1", "m2", "m3"})
        code, output = await two.rce(
            *("backup", str(two.folder / "backup.tar"), "--state-dir", str(two.state)),
            *("--store", f"etcds://{two.machine.address}:2379"),
        )
        assert code == 0, output
        _check_backup(two.folder / "backup.tar")

        authority = str(one.state / "certificates" / "authority.pem")
        urls = [host.url for host in (one, two, three)]
        writer = one.program("writer", sys.executable, "-c", WRITER, authority, PASSWORD, *urls)
        await writer.start(ready="acknowledged ", timeout=START_S)
        await three.lose()
        await wait_for_writes(writer)
        await give_certificate(one, four)
        code, output = await four.rce(*four.cluster_words("join", one.machine.address))
        assert (code, "rce cluster remove m3" in output) == (1, True), output
        code, output = await one.rce("cluster", "remove", "m2", "--state-dir", str(one.state))
        assert (code, "m3 does not answer" in output) == (1, True), output
        code, output = await one.rce("cluster", "remove", "m3", "--state-dir", str(one.state))
        assert (code, "the other masters do not count m3:9000 any more" in output) == (0, True), output
        await wait_for_writes(writer)
        await four.start_etcd("join", f"{one.machine.address},{two.machine.address}")
        await four.start_master()
        await wait_until_whole(two, {"m1", "m2", "m4"})
        await wait_for_writes(writer)
        await writer.kill()

        # The first machine fails too: the new one has the state, or it would have no quorum.
        await one.lose()
        await until(
            lambda: _leads_one_of(two, {"m2", "m4"}), timeout=START_S, what="another master leads without m1"
        )
        authority = str(four.state / "certificates" / "authority.pem")
        code, output = await four.run(sys.executable, "-c", LISTING, authority, PASSWORD, four.url)
        assert code == 0, output
        assert set(acknowledged(writer)) <= set(json.loads(output))


def _check_backup(file: Path) -> None:
    """It has the state and this machine's certificates, and nothing of its etcd."""
    with tarfile.open(file) as tar:
        names = tar.getnames()
    assert {"master/rce.sqlite", "certificates/engine.key", "certificates/authority.pem"} <= set(names)
    assert not [name for name in names if "etcd" in name]


async def _leads_one_of(host: Host, names: set[str]) -> bool:
    found = await host.status()
    with contextlib.suppress(KeyError):
        return any(each["role"] == "leader" and each["name"] in names for each in found["masters"])
    return False


async def test_refused_joins_change_nothing(folder: Path) -> None:
    """Names and addresses are unique, certificates must be there, and data is never overwritten."""
    async with hosts(folder, 2) as (one, two):
        await one.start_etcd("init")
        code, output = await two.rce(*two.cluster_words("join", one.machine.address))
        assert (code, "rce certificate issue m2 --host 10.77.0.2" in output) == (1, True), output
        await give_certificate(one, two)
        words = two.cluster_words("join", one.machine.address)
        words[words.index("m2")] = "m1"
        code, output = await two.rce(*words)
        assert (code, "a member is named m1 already" in output) == (1, True), output
        words = two.cluster_words("join", one.machine.address)
        words[words.index("10.77.0.2")] = "10.77.0.9"
        code, output = await two.rce(*words)
        assert (code, "10.77.0.9" in output) == (1, True), output
        code, output = await two.rce(*two.cluster_words("join", "10.77.0.9"))
        assert (code, "etcd does not answer" in output) == (1, True), output
        code, output = await one.rce(*one.cluster_words("join", two.machine.address), "--peer-port", "2390")
        assert (code, "has the data of a member already" in output) == (1, True), output
        code, output = await one.rce("cluster", "remove", "m1", "--state-dir", str(one.state))
        assert (code, "the last member" in output) == (1, True), output
        code, output = await two.rce("cluster", "status", "--state-dir", str(two.state))
        assert (code, "this machine is in no cluster" in output) == (1, True), output
        found = await one.status()
        assert [each["name"] for each in found["members"]] == ["m1"]


async def test_machine_that_is_left_recovers_the_state(folder: Path) -> None:
    """Of two machines one is lost for good; the other has all that was acknowledged, and a new one joins."""
    async with hosts(folder, 3) as (one, two, three):
        await one.start_etcd("init")
        store = f"etcds://{one.machine.address}:2379"
        here = ("--state-dir", str(one.state))
        code, output = await one.rce(
            *("user", "add", USER, "--admin", "--password-stdin", *here, "--store", store), given=PASSWORD
        )
        assert code == 0, output
        await one.start_master()
        await give_certificate(one, two)
        await two.start_etcd("join", one.machine.address)
        await two.start_master()
        authority = str(one.state / "certificates" / "authority.pem")
        writer = one.program("writer", sys.executable, "-c", WRITER, authority, PASSWORD, one.url, two.url)
        await writer.start(ready="acknowledged ", timeout=START_S)
        await wait_for_writes(writer, 10)
        await end_etcd(one)  # m2 is in the data only: it joined later
        code, output = await one.rce("cluster", "recover", *here)
        assert (code, "m2 (10.77.0.2:2379) works" in output) == (1, True), output
        await one.start_etcd("init")
        await wait_for_writes(writer)
        await two.lose()
        await until(lambda: _has_no_quorum(one), timeout=START_S, what="etcd has no quorum")
        code, output = await one.rce("cluster", "remove", "m2", "--force", *here)
        assert (code, "rce cluster recover" in output) == (1, True), output
        code, output = await one.rce("cluster", "recover", *here)
        assert (code, "stop rce-master rce-etcd" in output) == (1, True), output
        await writer.kill()
        assert one.master is not None
        await one.master.kill()
        await end_etcd(one)

        code, output = await one.rce("cluster", "recover", *here)
        assert (code, "m1 is a cluster of its own" in output) == (0, True), output
        await one.start_etcd("init")
        await one.start_master()
        await until(lambda: _leads_one_of(one, {"m1"}), timeout=START_S, what="the master leads alone")
        code, output = await one.run(sys.executable, "-c", LISTING, authority, PASSWORD, one.url)
        assert code == 0, output
        assert set(acknowledged(writer)) <= set(json.loads(output))
        await give_certificate(one, three)
        await three.start_etcd("join", one.machine.address)
        assert {each["name"] for each in (await one.status())["members"]} == {"m1", "m3"}


async def end_etcd(host: Host) -> None:
    """End etcd in order, which takes long without a quorum: killing the command would leave etcd."""
    assert host.etcd is not None
    assert host.etcd.process is not None
    host.etcd.process.terminate()
    async with asyncio.timeout(START_S):
        await host.etcd.process.wait()


async def _has_no_quorum(host: Host) -> bool:
    return any("etcd has no quorum" in text for text in (await host.status()).get("advice", ()))
