"""``rce cluster ... --foreground`` keeps nothing running that it started."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import psutil
import pytest
from support.engine import Program, until
from support.go_between import LOOPBACK
from support.ports import free_ports
from support.processes import run_to_end

pytestmark = [pytest.mark.e2e, pytest.mark.needs("etcd"), pytest.mark.timeout(300), pytest.mark.asyncio]

START_S = 120.0


async def test_killed_cluster_command_ends_its_etcd(tmp_path: Path) -> None:
    client, peer = free_ports(2)
    kept = {key: value for key, value in os.environ.items() if not key.startswith("RCE_")}
    argv = [
        *(str(Path(sys.executable).parent / "rce"), "cluster", "init", "--address", LOOPBACK, "--no-tls"),
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


def works(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE  # it has no parent that waits for it
    except psutil.NoSuchProcess:
        return False


async def test_first_user_is_asked_for_until_there_is_one(tmp_path: Path) -> None:
    """No user can be added over the API before, nor beside a master that leads."""
    client, peer = free_ports(2)
    kept = {key: value for key, value in os.environ.items() if not key.startswith("RCE_")}
    env, state = kept | {"HOME": str(tmp_path)}, tmp_path / "state"
    rce = str(Path(sys.executable).parent / "rce")
    command = Program(
        "cluster",
        [
            *(rce, "cluster", "init", "--address", LOOPBACK, "--no-tls", "--foreground"),
            *("--state-dir", str(state), "--client-port", str(client), "--peer-port", str(peer)),
        ],
        env,
        tmp_path,
    )
    for is_asked_for in (True, False):
        await command.start(ready="etcd ready: ", timeout=START_S)
        try:
            said = command.output().rpartition("warning: without TLS")[2]
            assert ("next, add the first user: rce user add" in said) == is_asked_for, said
            store = ("--state-dir", str(state), "--store", f"etcd://{LOOPBACK}:{client}")
            words = ("user", "add", f"user{is_asked_for}", "--password-stdin", *store)
            code, output = await run_to_end(rce, *words, env=env, text="a long password")
            assert code == 0, output
        finally:
            await command.stop()
