"""``rce backup`` of a master under load, and ``rce restore`` in another folder."""

from __future__ import annotations

import asyncio
import io
import json
import os
import sqlite3
import stat
import sys
import tarfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from support.engine import Program
from support.forked_commands import run_command
from support.ports import free_ports

from rce_master.backup import MANIFEST
from rce_master.store.base import SCHEMA_VERSION

pytestmark = pytest.mark.timeout(300)

BIN = Path(sys.executable).parent
NODE = "from rce.ros.node import Node\n"


def environment(folder: Path) -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "XDG_"))}
    return kept | {
        "HOME": str(folder),
        "RCE_SECRET": "a secret for the tests",
        "RCE_LOGIN_FILE": str(folder / "login.json"),
        "COLUMNS": "300",
    }


async def rce(folder: Path, *words: str, typed: str = "", code: int = 0) -> str:
    ended, output = await run_command(words, env=environment(folder), folder=folder, typed=typed)
    assert ended == code, output
    return output


@asynccontextmanager
async def running_master(folder: Path, state: Path) -> AsyncIterator[str]:
    """Run a master on the folder ``master`` of an engine's state folder."""
    (port,) = free_ports(1)
    settings = folder / "engine.yaml"
    settings.write_text(f"dev: true\nstate_dir: {state}\nmaster: {{http_port: {port}, control_port: 0}}\n")
    argv = [str(BIN / "rce-master"), "--config", str(settings)]
    program = Program(f"master-{state.name}", argv, environment(folder), folder)
    await program.start(timeout=90)
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        await program.stop()


class Load:
    """A client that changes the state all the time."""

    def __init__(self, url: str, token: str) -> None:
        self.made: list[str] = []
        self._url = f"{url}api/v1/containers"
        self._headers = {"Authorization": f"Bearer {token}"}

    async def run(self) -> None:
        async with aiohttp.ClientSession(headers=self._headers) as session:
            while len(self.made) < 900:
                tag = f"c{len(self.made)}"
                async with session.post(self._url, json={"tag": tag}) as reply:
                    assert reply.status == 204, await reply.text()
                self.made.append(tag)
            await asyncio.Event().wait()


async def get(url: str, path: str, token: str) -> Any:
    async with (
        aiohttp.ClientSession(headers={"Authorization": f"Bearer {token}"}) as session,
        session.get(f"{url}api/v1/{path}") as reply,
    ):
        assert reply.status == 200, await reply.text()
        return await reply.json()


async def test_backup_under_load_is_restored_elsewhere(tmp_path: Path) -> None:
    state, other = tmp_path / "state", tmp_path / "other"
    package = tmp_path / "shout"
    (package / "nodes").mkdir(parents=True)
    (package / "package.yaml").write_text("name: shout\nversion: '1.0.0'\npython: engine\n")
    (package / "nodes" / "shout.py").write_text(NODE)
    copies: list[tuple[Path, int, int]] = []
    async with running_master(tmp_path, state) as url:
        await rce(tmp_path, "login", url, "--user", "testUser", "--password-stdin", typed="testUser\n")
        await rce(tmp_path, "user", "add", "anna", "--password-stdin", typed="a password\n")
        await rce(tmp_path, "package", "push", str(package))
        token = json.loads((tmp_path / "login.json").read_text())["token"]
        (state / "certificates").mkdir()
        (state / "certificates" / "authority.key").write_text("a key")
        (state / "certificates" / "authority.key").chmod(0o600)
        load = Load(url, token)
        working = asyncio.create_task(load.run())
        for number in range(3):
            file = tmp_path / f"backup{number}.tar"
            before = len(load.made)
            told = await rce(tmp_path, "backup", str(file), "--state-dir", str(state))
            assert f"made {file}" in told
            copies.append((file, before, len(load.made) + 1))
            assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert not working.done()
        working.cancel()
        refused = await rce(tmp_path, "restore", str(file), "--state-dir", str(state), code=1)
        assert "a master is running" in refused
    assert copies[0][2] > copies[0][1] + 1, "the state changed while it was copied"
    file, least, most = copies[-1]
    told = await rce(tmp_path, "restore", str(file), "--state-dir", str(other))
    assert f"restored {other}/master" in told
    assert (other / "certificates" / "authority.key").read_text() == "a key"
    assert stat.S_IMODE((other / "certificates" / "authority.key").stat().st_mode) == 0o600
    async with running_master(tmp_path, other) as url:
        found = {each["tag"] for each in (await get(url, "containers", token))["containers"]}
        assert set(load.made[:least]) <= found, "what was confirmed before the copy is in it"
        assert least <= len(found) <= most
        assert {each["name"] for each in (await get(url, "users", token))["users"]} == {"anna", "testUser"}
        packages = (await get(url, "packages", token))["packages"]
        assert [each["name"] for each in packages] == ["shout"]
        archive = other / "master" / "bundles" / packages[0]["sha256"]
        assert archive.read_bytes() == (state / "master" / "bundles" / archive.name).read_bytes()


@pytest.fixture
async def copy(tmp_path: Path) -> Path:
    state = tmp_path / "state"
    await rce(tmp_path, "user", "add", "anna", "--password-stdin", "--state-dir", str(state), typed="x\n")
    file = tmp_path / "backup.tar"
    await rce(tmp_path, "backup", str(file), "--state-dir", str(state))
    return file


def change(file: Path, edit: Callable[[str, bytes], bytes | None]) -> None:
    """Write a copy anew with other contents."""
    with tarfile.open(file) as tar:
        old = [(member, opened.read()) for member in tar if (opened := tar.extractfile(member)) is not None]
    with tarfile.open(file, "w") as tar:
        for member, data in old:
            content = edit(member.name, data)
            if content is not None:
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))


async def test_former_state_is_moved_aside_only_when_told(copy: Path, tmp_path: Path) -> None:
    state = tmp_path / "state"
    await rce(tmp_path, "user", "add", "ben", "--password-stdin", "--state-dir", str(state), typed="x\n")
    where = ("--state-dir", str(state))
    assert "give --replace" in await rce(tmp_path, "restore", str(copy), *where, code=1)
    assert "ben" in await rce(tmp_path, "user", "list", *where)
    told = await rce(tmp_path, "restore", str(copy), *where, "--replace")
    assert "ben" not in await rce(tmp_path, "user", "list", *where)
    (former,) = [line.split()[-1] for line in told.splitlines() if "former state" in line]
    assert "ben" in await rce(tmp_path, "user", "list", "--state-dir", former)
    assert "is there already" in await rce(tmp_path, "backup", str(copy), *where, code=1)


def newer_manifest(name: str, data: bytes) -> bytes:
    return (
        json.dumps(json.loads(data) | {"schema": SCHEMA_VERSION + 1}).encode() if name == MANIFEST else data
    )


def without_manifest(name: str, data: bytes) -> bytes | None:
    return None if name == MANIFEST else data


def flipped(name: str, data: bytes) -> bytes:
    return data[:-1] + bytes([data[-1] ^ 1]) if name.endswith(".sqlite") else data


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (newer_manifest, "newer than this program"),
        (without_manifest, "is not a whole backup"),
        (flipped, "is damaged: master/rce.sqlite"),
    ],
)
async def test_bad_copy_is_refused_and_changes_nothing(
    edit: Callable[[str, bytes], bytes | None], told: str, copy: Path, tmp_path: Path
) -> None:
    change(copy, edit)
    (tmp_path / "new").mkdir()
    state = tmp_path / "new" / "state"
    assert told in await rce(tmp_path, "restore", str(copy), "--state-dir", str(state), code=1)
    assert not list((tmp_path / "new").iterdir())


async def test_store_of_a_newer_program_is_not_copied(tmp_path: Path) -> None:
    state = tmp_path / "state"
    await rce(tmp_path, "user", "add", "anna", "--password-stdin", "--state-dir", str(state), typed="x\n")
    (store,) = state.rglob("rce.sqlite")
    with closing(sqlite3.connect(store)) as database:
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    told = await rce(tmp_path, "backup", str(tmp_path / "b.tar"), "--state-dir", str(state), code=1)
    assert f"has version {SCHEMA_VERSION + 1}" in told
    assert not (tmp_path / "b.tar").exists()


async def test_copy_with_paths_outside_is_refused(copy: Path, tmp_path: Path) -> None:
    with tarfile.open(copy, "a") as tar:
        member = tarfile.TarInfo("master/../../escaped")
        member.size = 1
        tar.addfile(member, io.BytesIO(b"x"))
    told = await rce(tmp_path, "restore", str(copy), "--state-dir", str(tmp_path / "new"), code=1)
    assert "which no backup does" in told
    assert not list(tmp_path.rglob("escaped"))


async def test_folder_without_state_is_not_copied(tmp_path: Path) -> None:
    told = await rce(tmp_path, "backup", "b.tar", "--state-dir", str(tmp_path / "nothing"), code=1)
    assert "is not a master's state folder" in told
    assert "--store" in told
