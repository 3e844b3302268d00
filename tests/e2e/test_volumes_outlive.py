"""A volume outlives its container, kill -9 of everything, and is removed only on request; by REST and CLI."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
from support.container_nodes import NODES
from support.engine import Engine, running_engine, until
from support.short_folders import TMP

from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError

pytestmark = [pytest.mark.e2e, pytest.mark.needs("bwrap")]

VOLUME = {"name": "journal", "path": "/data", "size": "16M"}
NODE = {"tag": "keep", "pkg": "own", "exe": "keep.py"}


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    nodes = tmp_path / "packages" / "own" / "nodes"
    nodes.mkdir(parents=True)
    (nodes / "keep.py").write_text(NODES["keep.py"])
    (nodes.parent / "package.yaml").write_text("name: own\n")
    for path in takewhile(TMP.__ne__, (tmp_path, *tmp_path.parents)):
        path.chmod(0o755)  # nodes are another user
    return tmp_path / "packages"


async def runs(client: ApiClient, number: int) -> None:
    """Wait until the node of the container has run so often."""

    async def said() -> bool:
        try:
            chunk = await client.call("GET", "/containers/C/nodes/keep/log", query={"stream": "stdout"})
        except ApiError:
            return False
        return f"/data {number} runs" in chunk["text"]

    await until(said, what=f"run {number}")


async def make(client: ApiClient) -> None:
    await client.call("POST", "/containers", {"tag": "C", "volumes": [VOLUME]})
    await client.call("POST", "/containers/C/nodes", NODE)


async def listed(client: ApiClient) -> list[dict[str, Any]]:
    return list((await client.call("GET", "/volumes"))["volumes"])


def kill_container(engine: Engine) -> None:
    engine.kill_processes("rce_container.environment")


async def refusal(client: ApiClient, method: str, path: str, body: Any = None, **query: str) -> str:
    with pytest.raises(ApiError) as caught:
        await client.call(method, path, body, query=dict(query))
    return f"{caught.value.status} {caught.value}"


async def test_a_volume_outlives_its_container(packages: Path) -> None:
    async with (
        running_engine(runtime="namespace", packages=packages) as engine,
        ApiClient(engine.url, engine.token()) as client,
    ):
        await make(client)
        await runs(client, 1)
        kill_container(engine)
        await runs(client, 2)
        (found,) = await listed(client)
        assert (found["name"], found["container"], found["path"]) == ("journal", "C", "/data")
        assert (found["size"], found["limit"] in ("image", "watched")) == (16 << 20, True)
        await engine.container.kill()
        kill_container(engine)
        await engine.container.start()
        await runs(client, 3)
        assert "409" in await refusal(client, "DELETE", "/volumes/journal")
        await client.call("DELETE", "/containers/C")
        await make(client)
        await runs(client, 4)
        await client.call("DELETE", "/containers/C")
        await check_others(engine, client)
        remove_by_command(engine)
        assert await listed(client) == []
        await make(client)
        await runs(client, 1)


async def check_others(engine: Engine, client: ApiClient) -> None:
    """Another user neither sees nor removes the volume, and has one of the same name."""
    await client.call("POST", "/users", {"name": "mallory", "password": "a long password", "role": "user"})
    login = {"userID": "mallory", "password": "a long password"}
    token = (await client.call("POST", "/login", login))["token"]
    async with ApiClient(engine.url, token) as mallory:
        assert await listed(mallory) == []
        assert "404" in await refusal(mallory, "DELETE", "/volumes/journal")
        (ours,) = await listed(client)
        assert "403" in await refusal(mallory, "DELETE", "/volumes/journal", user=ours["user"])
        for path, text in (("/proc", "must not hide /proc"), ("/etc/x", "hide /etc"), ("/a/../etc", "'..'")):
            body = {"tag": "D", "volumes": [{**VOLUME, "path": path}]}
            assert text in await refusal(mallory, "POST", "/containers", body)
        body = {"tag": "D", "volumes": [{**VOLUME, "name": "../journal"}]}
        assert "422" in await refusal(mallory, "POST", "/containers", body)


def remove_by_command(engine: Engine) -> None:
    login = engine.folder / "login.json"
    login.write_text(
        json.dumps({"url": engine.url, "user": "testUser", "token": engine.token(), "expires": 2e10})
    )
    for words in (("list",), ("remove", "journal", "--yes")):
        command = [str(Path(sys.executable).parent / "rce"), "volume", *words]
        done = subprocess.run(
            command,
            env={**os.environ, "RCE_LOGIN_FILE": str(login)},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        assert "journal" in done.stdout
