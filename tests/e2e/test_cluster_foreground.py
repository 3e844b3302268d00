"""``rce cluster ... --foreground`` keeps nothing running that it started."""

from __future__ import annotations

import os
import shlex
import shutil
import ssl
import sys
from http import HTTPStatus
from pathlib import Path

import aiohttp
import psutil
import pytest
from faults.machines import fetch
from support.engine import Program, until
from support.go_between import LOOPBACK
from support.ports import free_ports
from support.processes import run_to_end
from support.stored_packages import store_package

from rce.config import EngineSettings
from rce_master.backup import MASTER, back_up

pytestmark = [pytest.mark.e2e, pytest.mark.needs("etcd"), pytest.mark.timeout(300), pytest.mark.asyncio]

RCE = str(Path(sys.executable).parent / "rce")
START_S = 120.0


async def test_killed_cluster_command_ends_its_etcd(tmp_path: Path) -> None:
    client, peer = free_ports(2)
    kept = {key: value for key, value in os.environ.items() if not key.startswith("RCE_")}
    argv = [
        *(RCE, "cluster", "init", "--address", LOOPBACK, "--no-tls"),
        *("--foreground", "--state-dir", str(tmp_path / "state")),
        *("--client-port", str(client), "--peer-port", str(peer)),
    ]
    command = Program("cluster", argv, kept | {"HOME": str(tmp_path)}, tmp_path)
    try:
        await command.start(ready="etcd ready: ", timeout=START_S)
        (etcd,) = psutil.Process(command.pid).children()
        assert etcd.name() == "etcd"
    finally:
        if command.running:
            await command.kill()
    try:
        await until(lambda: not works(etcd), timeout=START_S, what="etcd ends with the command")
    finally:
        if works(etcd):
            etcd.kill()


async def test_ended_cluster_command_does_not_wait_for_an_etcd_that_hangs(tmp_path: Path) -> None:
    """One that leads may wait many minutes for a member whose machine was lost."""
    init = Init(tmp_path, "--no-tls")
    await init.start()
    (etcd,) = psutil.Process(init.program.pid).children()
    etcd.suspend()
    assert await init.program.stop() == 0
    assert not works(etcd)


def works(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE  # it has no parent that waits for it
    except psutil.NoSuchProcess:
        return False


class Init:
    """``rce cluster init --foreground`` on ports of its own."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.client, peer = free_ports(2)
        kept = {key: value for key, value in os.environ.items() if not key.startswith("RCE_")}
        self.state = folder / "state"
        self.env = kept | {"HOME": str(folder)}
        self.argv = [
            *(RCE, "cluster", "init", "--address", LOOPBACK, "--foreground", *options),
            *("--state-dir", str(self.state), "--client-port", str(self.client), "--peer-port", str(peer)),
        ]
        self.program = Program("cluster", self.argv, self.env, folder)

    async def start(self) -> None:
        await self.program.start(ready="etcd ready: ", timeout=START_S)

    async def add_user(self, name: str) -> tuple[int, str]:
        store = ("--state-dir", str(self.state), "--store", f"etcd://{LOOPBACK}:{self.client}")
        words = ("user", "add", name, "--password-stdin", *store)
        return await run_to_end(RCE, *words, env=self.env, text="a long password")


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("etcd Version: 3.3.25", "is version 3.3; version 3.4 or later is needed"),
        ("\x1b[31mhello" + "o" * 1000, r'does not tell a version of etcd: "\u001b[31mhello'),
    ],
)
async def test_another_program_of_that_name_is_refused(tmp_path: Path, said: str, words: str) -> None:
    init = Init(tmp_path, "--no-tls")
    program = tmp_path / "bin" / "etcd"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho '{said}'\n")
    program.chmod(0o755)
    env = init.env | {"PATH": f"{program.parent}:{init.env['PATH']}"}
    code, output = await run_to_end(*init.argv, env=env)
    assert (code, words in output, len(output) < 500) == (1, True, True), output


async def test_first_user_is_asked_for_until_there_is_one(tmp_path: Path) -> None:
    """No user can be added over the API before, nor beside a master that leads."""
    init = Init(tmp_path, "--no-tls")
    for is_asked_for in (True, False):
        await init.start()
        try:
            said = init.program.output().rpartition("warning: without TLS")[2]
            assert ("next, add the first user: rce user add" in said) == is_asked_for, said
            code, output = await init.add_user(f"user{is_asked_for}")
            assert code == 0, output
        finally:
            await init.program.stop()


async def test_archives_are_restored_to_the_folder_of_the_master(tmp_path: Path) -> None:
    """The master of the machine did not run yet: its folder does not exist."""
    init = Init(tmp_path, "--no-tls")
    archive = b"an archive"
    await make_backup(tmp_path, archive)
    await init.start()
    try:
        store = f"etcd://{LOOPBACK}:{init.client}"
        words = ("restore", str(tmp_path / "copy.tar"), "--store", store, "--state-dir", str(init.state))
        code, output = await run_to_end(RCE, *words, env=init.env)
        assert code == 0, output
        _, _, told = init.program.output().partition("run the master: ")
        master = Path(shlex.split(told.splitlines()[0])[2])
        assert master == EngineSettings(state_dir=init.state).master_state, "where the service has it"
        assert [path.read_bytes() for path in (master / "bundles").iterdir()] == [archive]
    finally:
        await init.program.stop()


async def make_backup(folder: Path, archive: bytes) -> None:
    """Make ``copy.tar`` of a state with a package."""
    state = folder / "one" / "master"
    kept = await store_package(state, archive)
    kept.parent.mkdir()
    kept.write_bytes(archive)
    back_up({MASTER: state}, folder / "copy.tar")


async def test_lost_data_does_not_begin_another_cluster(tmp_path: Path) -> None:
    """A master on it would lead with an empty state, and task sets would end all containers."""
    init = Init(tmp_path, "--no-tls")
    await init.start()
    await init.program.stop()
    shutil.rmtree(init.state / "etcd")
    etcd = Program("etcd", ["etcd", "--config-file", str(init.state / "etcd.yaml")], init.env, tmp_path)
    await etcd.start(ready="")
    try:

        async def outcome() -> str:
            if not etcd.running:
                return "ended"
            return "serves" if await fetch(f"http://{LOOPBACK}:{init.client}/health") else ""

        assert await until(outcome, timeout=START_S, what="etcd serves or ends") == "ended"
    finally:
        if etcd.running:
            await etcd.stop()
    code, output = await run_to_end(*init.argv, env=init.env)
    assert (code, "its data is lost" in output) == (1, True), output
    (init.state / "etcd.yaml").unlink()
    shutil.rmtree(init.state / "etcd", ignore_errors=True)
    await init.start()
    await init.program.stop()


async def test_requests_with_a_certificate_are_not_logged_by_etcd(tmp_path: Path) -> None:
    """A master asks several times a second: each line would be one of thousands in an hour."""
    init = Init(tmp_path)
    await init.start()
    try:
        assert '"warn"' in init.program.output(), "its warnings are shown"
        assert "ignoring common name" not in init.program.output()
    finally:
        await init.program.stop()


async def test_etcd_refuses_a_certificate_from_its_revocation_on(tmp_path: Path) -> None:
    """A stolen machine must not read the state, which holds the hashes of passwords."""
    init = Init(tmp_path)
    await init.start()
    folder = init.state / "certificates"
    try:
        await rce_certificate(init, "issue", "m2", "--host", LOOPBACK)
        assert await serves(init.client, folder, "m2")
        await rce_certificate(init, "revoke", "m2")
        assert not await serves(init.client, folder, "m2")
        assert await serves(init.client, folder, "engine")
    finally:
        await init.program.stop()


async def rce_certificate(init: Init, *words: str) -> None:
    argv = (RCE, "certificate", *words, "--certificates", str(init.state / "certificates"))
    code, output = await run_to_end(*argv, env=init.env)
    assert code == 0, output


async def serves(port: int, folder: Path, name: str) -> bool:
    """Ask etcd with a certificate; return whether it answered."""
    context = ssl.create_default_context(cafile=str(folder / "authority.pem"))
    context.load_cert_chain(folder / f"{name}.pem", folder / f"{name}.key")
    connector = aiohttp.TCPConnector(ssl=context)
    async with aiohttp.ClientSession(connector=connector) as session:
        try:
            async with session.get(f"https://{LOOPBACK}:{port}/health") as answer:
                return answer.status == HTTPStatus.OK
        except aiohttp.ClientError:
            return False
