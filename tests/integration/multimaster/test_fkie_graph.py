"""What fkie's programs and ours say to each other within one ROS graph."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.engine import Program
from support.multimaster import STRING, DiscoveryNetwork, node, process, ros_environment
from support.ports import free_port

from rce.ros.core import Core
from rce.ros.multimaster.discovery import Discovery

SCRIPT = Path(__file__).parents[2] / "support" / "fkie_graph_peer.py"
MASTER_STATE_MD5 = "d25ba81effb888c4150d378d8adedb03"
LINK_STATES_MD5 = "36d101076ab31009020bc3d52fdd6264"

pytestmark = pytest.mark.needs("rospy")


@asynccontextmanager
async def fkie(uri: str, home: Path, *arguments: str) -> AsyncIterator[asyncio.StreamReader]:
    """Run the peer; yields its output."""
    env = ros_environment(uri, home)
    async with process("/usr/bin/python3", str(SCRIPT), *arguments, env=env) as peer:
        assert peer.stdout is not None
        yield peer.stdout


async def words_that(output: asyncio.StreamReader, *beginning: str) -> list[str]:
    """Wait for a line that begins with these words."""
    async with asyncio.timeout(30):
        while line := await output.readline():
            words = line.decode().split()
            if words[: len(beginning)] == list(beginning):
                return words
    raise AssertionError(f"the peer ended before it said {beginning}")


def cli(name: str, folder: Path, *arguments: str) -> Program:
    text = f"import typer; from rce.ros.cli.{name} import {name}; typer.run({name})"
    return Program(name, [sys.executable, "-c", text, *arguments], {"ROS_IP": "127.0.0.1"}, folder)


async def test_fkie_hears_our_discovery(network: DiscoveryNetwork, tmp_path: Path) -> None:
    """``rce discovery`` says ``new``, ``changed`` and ``removed`` as releases 1.1.0 to 1.3.2 expect it."""
    async with Core(port=0) as core, Core(port=0) as other:
        ours = cli(
            "discovery",
            tmp_path,
            *(
                "--master-uri",
                core.uri,
                "--name",
                "ours",
                "--rpc-port",
                str(free_port()),
                "--heartbeat-hz",
                "10",
            ),
            *("--mcast-group", "226.0.0.0@127.0.0.1", "--mcast-port", str(network.port)),
        )
        await ours.start(ready="")
        try:
            async with fkie(core.uri, tmp_path, "listen") as output:
                assert (await words_that(output, "md5"))[1:] == [MASTER_STATE_MD5, LINK_STATES_MD5]
                assert abs(float((await words_that(output, "link", "ours"))[2])) < 60
                async with Discovery(network.settings(other.uri, name="other")):
                    await words_that(output, "change", "new", "other")
                    async with node("n", other.uri) as talker:
                        await talker.advertise("said", STRING)
                        await words_that(output, "change", "changed", "other")
                await words_that(output, "change", "removed", "other")
        finally:
            assert await ours.stop() == 0


@pytest.mark.parametrize(
    ("state", "quoted"),
    [
        pytest.param("new", (), id="plain"),
        pytest.param("'new'", ("quoted",), id="quoted"),
    ],
)
async def test_our_sync_hears_fkie_without_its_messages(
    network: DiscoveryNetwork, tmp_path: Path, state: str, quoted: tuple[str, ...]
) -> None:
    """Its list is empty and told once: what ``rce sync`` registers, it knows from ``changes`` alone."""
    async with Core(port=0) as here, Core(port=0) as there, node("n", there.uri) as talker:
        await talker.advertise("said", STRING)
        async with Discovery(
            network.settings(there.uri, name="there", send_mcast=False, listen_mcast=False)
        ) as discovery:
            about = (state, "there", there.uri, discovery.monitor_uri)
            async with fkie(here.uri, tmp_path, "discover", *about, *quoted) as output:
                await words_that(output, "ready")
                sync = cli("sync", tmp_path, "--master-uri", here.uri)
                await sync.start(ready="")
                try:
                    await here.wait_until(lambda graph: "/n" in graph.publishers("/said"), timeout=40)
                finally:
                    assert await sync.stop() == 0
