"""The examples of the page for ERPs work: its Python program, its curl bodies, and ``rce fleet``."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import sys
import time
from pathlib import Path

import aiohttp
from support.fleet_station import fleet_station
from support.managed_fleet import managed_fleet

PAGE = (Path(__file__).parents[3] / "docs/how-to/connect-an-erp.md").read_text()
RCE = str(Path(sys.executable).parent / "rce")


def block(kind: str, beginning: str) -> str:
    """Return the page's block of code that begins so."""
    found = re.search(rf"```{kind}\n({re.escape(beginning)}.*?)```", PAGE, re.DOTALL)
    assert found is not None, beginning
    return found[1]


async def run(*command: str, url: str, folder: Path) -> str:
    """Run a program; return its output."""
    environ = {**os.environ, "RCE_STATION": url, "RCE_LOGIN_FILE": str(folder / "none.json")}
    environ.pop("RCE_STATION_TOKEN", None)
    process = await asyncio.create_subprocess_exec(
        *command, env=environ, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    async with asyncio.timeout(90):
        output, errors = await process.communicate()
    assert process.returncode == 0, f"{command}: {errors.decode()}"
    return output.decode()


async def check_curl(url: str) -> None:
    """Send the bodies of the page's requests for tasks."""
    created = re.findall(r"-d '({\"stops\".*?})'", PAGE, re.DOTALL)
    changed = re.findall(r"-d '({\"(?:priority|reason)\".*?})'", PAGE)
    assert (len(created), len(changed)) == (1, 2)
    async with aiohttp.ClientSession(url) as session:
        headers = {"Idempotency-Key": "order-4711"}
        async with session.post("/api/v1/tasks", data=created[0], headers=headers) as reply:
            assert (reply.status, (await reply.json())["id"]) == (201, "T1")
            tag = {"If-Match": reply.headers["ETag"]}
        async with session.patch("/api/v1/tasks/T1", data=changed[0], headers=tag) as reply:
            assert reply.status in (200, 412)  # 412: a robot has it meanwhile
        async with session.get("/api/v1/openapi.json") as reply:
            paths = json.loads(await reply.text())["paths"]
    for path in (
        "/tasks",
        "/tasks/{id}/hold",
        "/events",
        "/history",
        "/webhooks",
        "/robots/{robot}/take-out",
    ):
        assert f"/api/v1{path}" in paths


async def check_commands(url: str, folder: Path) -> None:
    """Run each command of the page; a task that begins later takes the place of T1."""
    later = {"stops": [{"cell": 5}], "earliest_start": time.time() + 3600}
    async with aiohttp.ClientSession(url) as session, session.post("/api/v1/tasks", json=later) as reply:
        waiting = str((await reply.json())["id"])
    lines = [
        line[2:] for line in block("console", "$ rce fleet").splitlines() if line.startswith("$ rce fleet")
    ]
    assert len(lines) == 25
    said = {}
    for line in lines:
        words = [waiting if word == "T1" else word for word in shlex.split(line.partition(" > ")[0])]
        if "--key" in words:  # the page's request with curl had a deadline: another content
            words[words.index("--key") + 1] = "order-4713"
        if "watch" not in words:
            said[" ".join(words[2:4])] = await run(RCE, *words[1:], url=url, folder=folder)
    assert re.fullmatch(r"T[0-9]+\n", said["task add"])
    assert waiting in next(text for words, text in said.items() if words.startswith("tasks"))
    assert said["task hold"] == f"{waiting} is held\n"
    assert said["task cancel-many"].endswith(" tasks are cancelled, or bring their loads away first\n")
    assert "Robot1" in next(text for words, text in said.items() if words.startswith("robots"))
    assert "out" in said["take-out Robot2"]
    assert "paused" in said["pause --all"]
    assert said["block 17"] == "cell 17 is blocked\ncell 18 is blocked\n"
    assert said["block 26"].startswith("cell 26 is blocked until ")
    assert said["block 33>34"].startswith("the move 33>34 is blocked for Robot1 until ")
    assert said["free 17"] == "cell 17 is free\ncell 26 is free\nthe move 33>34 is free\n"
    assert said["place add"] == "charger: 56 63\n"
    assert said["place list"].splitlines()[0].split() == ["cell", "kind", "robot"]
    assert said["history --hours"].startswith("number,time,kind")


async def check_watch(url: str, folder: Path) -> None:
    """Follow from the first event, until Ctrl-C."""
    environ = {**os.environ, "RCE_STATION": url, "RCE_LOGIN_FILE": str(folder / "none.json")}
    process = await asyncio.create_subprocess_exec(
        RCE, "fleet", "watch", "--after", "0", env=environ, stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    async with asyncio.timeout(150):
        assert (await process.stdout.readline()).startswith(b"1  ")
    process.terminate()
    await process.wait()


async def test_examples_for_erps_work(tmp_path: Path) -> None:
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        async with asyncio.timeout(150):
            while (await fleet.ask("GET", "/map")).status != 200:
                await asyncio.sleep(0.1)
        async with fleet_station(fleet.core.uri) as url:
            await check_curl(url)
            program = tmp_path / "erp.py"
            program.write_text(block("python", "import asyncio").replace("http://127.0.0.1:9080", url))
            output = await run(sys.executable, str(program), url=url, folder=tmp_path)
            assert "made all stops" in output, output
            await check_commands(url, tmp_path)
            await check_watch(url, tmp_path)
