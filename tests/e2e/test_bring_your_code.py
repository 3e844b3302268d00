"""A robot's owner brings a package to a running engine, as the page in ``docs/how-to`` says."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.engine import Engine, running_engine
from support.owner import Owner
from support.stranger import stranger

from rce.ros.core import Core
from rce.ros.node import Node

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "bring-your-code.md"
FILE = re.compile(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", re.DOTALL)
RUNTIMES = ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))]

pytestmark = [pytest.mark.e2e]


def write_files(folder: Path, url: str) -> None:
    for name, text in FILE.findall(PAGE.read_text()):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("http://127.0.0.1:9000/", url))


@asynccontextmanager
async def bridge(owner: Owner, core: Core) -> AsyncIterator[None]:
    """``rce-ros`` with the robot's config."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce_client.ros_bridge", "my-robot.config"),
        cwd=owner.folder,
        env={**os.environ, "ROS_MASTER_URI": core.uri},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(180):
            while b"rce-ros ready" not in (line := await process.stdout.readline()):
                assert line, "rce-ros ended"
        yield
    finally:
        process.terminate()
        await process.communicate()


async def ask(core: Core, text: str) -> str:
    """Say something at the robot until the node in the cloud has heard it; return what comes back."""
    async with Node("robot", argv=[], master_uri=core.uri) as node:
        quiet = await node.advertise("/quiet", "std_msgs/String")
        loud = await node.subscribe("/loud", "std_msgs/String")

        async def answer() -> str:
            async for heard in loud:
                if heard.data.startswith(text.upper()):
                    return str(heard.data)
            raise AssertionError("nothing came back")

        async with asyncio.timeout(180):
            answering = asyncio.create_task(answer())
            while not answering.done():
                quiet.publish(data=text)
                await asyncio.wait([answering], timeout=0.2)
            return await answering


def node_of(engine: Engine) -> tuple[str, int]:
    """The only node: its package and its process."""
    (node,) = engine.get("/api/v1/nodes")["nodes"]
    assert node["pid"]
    return node["pkg"], node["pid"]


@pytest.mark.parametrize("runtime", RUNTIMES)
async def test_a_pushed_package_answers_its_owner_through_restarts(runtime: str) -> None:
    async with running_engine(runtime=runtime) as engine, Core(host="127.0.0.1", port=0) as core:
        owner = Owner(engine, "testUser")
        write_files(owner.folder, engine.url)
        await owner.login()
        told = await owner.rce("package", "push", "shout")
        assert "nodes/shout.py" in told
        assert "pushed shout@1.0.0" in told
        async with bridge(owner, core):
            assert await ask(core, "hello") == "HELLO!"
            before = node_of(engine)

            await engine.master.kill()
            await engine.master.start()
            await engine.container.kill()
            await engine.container.start()
            assert await ask(core, "again") == "AGAIN!"
            assert node_of(engine) == before

            source = owner.folder / "shout" / "nodes" / "shout.py"
            source.write_text(source.read_text().replace('+ "!"', '+ "!!"'))
            assert "a version never changes" in await owner.rce("package", "push", "shout", fails=True)
            await owner.rce("package", "push", "shout", "--version", "1.1")
            assert "1.1 (newest)" in await owner.rce("package", "list")
            assert await ask(core, "still") == "STILL!"
            refused = await owner.rce("package", "remove", "shout", "1.0.0", fails=True)
            assert "brain/shout" in refused
        config = owner.folder / "my-robot.config"
        config.write_text(config.read_text().replace('"shout@1.0.0"', '"shout"'))
        async with bridge(owner, core):
            assert await ask(core, "newest") == "NEWEST!!"
        await owner.rce("package", "remove", "shout", "1.0.0")


async def test_another_user_neither_sees_nor_uses_it() -> None:
    async with running_engine() as engine:
        owner, other = Owner(engine, "testUser"), Owner(engine, "eve")
        write_files(owner.folder, engine.url)
        await owner.login()
        await owner.rce("package", "push", "shout")
        await owner.rce("user", "add", "eve", "--password-stdin", typed="eve\n")
        await other.login()
        assert "shout" not in await other.rce("package", "list")
        assert "there is no package" in await other.rce("package", "show", "shout", fails=True)
        await other.rce("package", "remove", "shout", "1.0.0", "--user", "testUser", fails=True)
        async with stranger(engine.url, user="eve", robot="r", password="eve") as robot:
            await robot.send("CC", {"containerTag": "c"})
            for tag, pkg in (("pinned", "shout@1.0.0"), ("any", "shout")):
                node = {"containerTag": "c", "nodeTag": tag, "pkg": pkg, "exe": "shout.py"}
                await robot.send("CN", {"addNodes": [node]})
            await robot.wait_error("you have no package 'shout' of version '1.0.0'")
            await robot.wait_error("no package 'shout' on the package path")
        request = urllib.request.Request(f"http://127.0.0.1:{engine.control_port}/contents/{'0' * 64}")
        with pytest.raises(urllib.error.HTTPError) as caught:
            await asyncio.to_thread(urllib.request.urlopen, request, timeout=10)
        with caught.value as refusal:
            assert refusal.code == 401
