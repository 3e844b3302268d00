"""``rce-master`` and the commands as real processes: kill -9, restart, users."""

from __future__ import annotations

import asyncio
import hashlib
import json
import signal
import socket
import stat
import sys
from typing import TYPE_CHECKING

import aiohttp
import pytest
from support.master_program import environment, master, rce
from websockets.asyncio.client import connect

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.timeout(300)  # each command is a process, which is slow on a busy machine


async def test_what_was_accepted_survives_kill_9(tmp_path: Path) -> None:
    async with master(tmp_path, "--dev", end=signal.SIGKILL) as url:
        await rce(tmp_path, "login", url, "--user", "testUser", "--password-stdin", text="testUser\n")
        headers = {"Authorization": f"Bearer {(await rce(tmp_path, 'token')).strip()}"}
        async with aiohttp.ClientSession(headers=headers) as session:
            for number in range(20):
                async with session.post(f"{url}api/v1/containers", json={"tag": f"c{number}"}) as reply:
                    assert reply.status == 204
    # The token is in the store too: nobody has to log in again.
    async with (
        master(tmp_path, "--dev", end=signal.SIGINT) as url,
        aiohttp.ClientSession(headers=headers) as session,
        session.get(f"{url}api/v1/containers") as reply,
    ):
        found = (await reply.json())["containers"]
    assert {c["tag"] for c in found} == {f"c{number}" for number in range(20)}


async def test_users_in_the_state_folder_and_over_the_api(tmp_path: Path) -> None:
    state = ("--state-dir", str(tmp_path / "state"))
    await rce(tmp_path, "user", "add", "root", "--admin", "--password-stdin", *state, text="secret\n")
    await rce(tmp_path, "user", "add", "anna", "--password-stdin", *state, text="one\n")
    assert "is a user 'anna' already" in (
        await rce(tmp_path, "user", "add", "anna", "--password-stdin", *state, text="x\n", code=1)
    )
    listed = await rce(tmp_path, "user", "list", *state)
    assert "root" in listed
    assert "admin" in listed
    assert "not logged in" in await rce(tmp_path, "ps", code=1)
    async with master(tmp_path, "--bind", "127.0.0.1") as url:
        assert "a master is running" in await rce(tmp_path, "user", "list", *state, code=1)
        refused = await rce(tmp_path, "login", url, "-u", "root", "--password-stdin", text="no\n", code=1)
        assert "wrong password" in refused
        await rce(tmp_path, "login", url, "-u", "root", "--password-stdin", text="secret\n")
        assert stat.S_IMODE((tmp_path / "login.json").stat().st_mode) == 0o600
        await rce(tmp_path, "user", "passwd", "anna", "--password-stdin", text="two\n")
        await rce(tmp_path, "user", "remove", "anna")
        assert "anna" not in await rce(tmp_path, "user", "list")
        assert json.loads(await rce(tmp_path, "ps", "--json"))["robots"] == []
        assert "container" in await rce(tmp_path, "ps")
        assert "there is no container" in await rce(tmp_path, "logs", "c/n", code=1)
        await rce(tmp_path, "logout")
        assert "not logged in" in await rce(tmp_path, "token", code=1)


async def test_a_master_that_cannot_start_says_why(tmp_path: Path) -> None:
    env = environment(tmp_path)
    del env["RCE_SECRET"]
    env["XDG_CONFIG_HOME"] = str(tmp_path / "config")
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce_master", "--state-dir", str(tmp_path / "state")),
        stderr=asyncio.subprocess.PIPE,
        env=env,
    )
    _, errors = await process.communicate()
    assert process.returncode == 1
    assert b"rce secret new" in errors
    assert b"Traceback" not in errors
    async with master(tmp_path, "--dev"):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rce_master", "--dev", "--state-dir", str(tmp_path / "state")),
            stderr=asyncio.subprocess.PIPE,
            env=environment(tmp_path),
        )
        _, errors = await process.communicate()
        assert process.returncode == 1
        assert b"a master is running" in errors
        assert b"Traceback" not in errors


async def test_the_log_tells_no_secret_however_much_it_tells(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    secret = environment(tmp_path)["RCE_SECRET"]
    options = ("--dev", "--log-level", "debug", "--control-port", str(port))
    async with master(tmp_path, *options) as url, aiohttp.ClientSession() as session:
        async with connect(
            f"ws://127.0.0.1:{port}", additional_headers={"Authorization": f"Bearer {secret}"}, proxy=None
        ):
            pass
        account = {"userID": "testUser", "password": "testUser"}
        async with session.post(f"{url}api/v1/login", json=account) as reply:
            token = (await reply.json())["token"]
    log = (tmp_path / "master.log").read_text()
    assert "DEBUG" in log
    assert [
        word for word in (secret, token, hashlib.sha256(b"testUser").hexdigest(), "argon2") if word in log
    ] == []


async def test_tokens_are_listed_and_revoked_by_commands(tmp_path: Path) -> None:
    async with master(tmp_path, "--dev") as url:
        login = ("login", url, "--user", "testUser", "--password-stdin")
        await rce(tmp_path, *login, text="testUser\n")
        first = (await rce(tmp_path, "token")).strip()
        await rce(tmp_path, *login, text="testUser\n")  # gives the first one back
        listed = await rce(tmp_path, "token", "list")
        assert listed.count("login") == 2, listed  # "this login", and its label
        made = (await rce(tmp_path, "robot", "add", "R1")).split()[0]
        assert made.startswith("rce_")
        assert "robot:R1" in await rce(tmp_path, "robot", "list")
        assert "has a token already" in await rce(tmp_path, "robot", "add", "R1", code=1)
        await rce(tmp_path, "robot", "revoke", "R1")
        assert "R1" not in await rce(tmp_path, "robot", "list")
        id_ = (await rce(tmp_path, "token", "list")).splitlines()[1].split()[0]
        await rce(tmp_path, "token", "revoke", id_)
        assert "log in again" in await rce(tmp_path, "token", "list", code=1)
        async with aiohttp.ClientSession(headers={"Authorization": f"Bearer {first}"}) as session:
            assert (await session.get(f"{url}api/v1/user")).status == 401


async def test_roles_and_audit_by_commands(tmp_path: Path) -> None:
    async with master(tmp_path, "--dev") as url:
        await rce(tmp_path, "login", url, "-u", "testUser", "--password-stdin", text="testUser\n")
        await rce(tmp_path, "user", "add", "eve", "--role", "viewer", "--password-stdin", text="one\n")
        await rce(tmp_path, "user", "role", "eve", "operator")
        assert "operator" in await rce(tmp_path, "user", "list")
        told = await rce(tmp_path, "audit", "--user", "testUser")
    assert "set_role  testUser/eve/operator" in told
    assert "add_user" in told
    assert "log_in" in told
