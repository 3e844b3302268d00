"""A core is killed with -9 and started again; nodes of ours continue, and are known to the next core."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest
from support.ports import free_port
from support.ros_nodes import MakeGraphNode
from support.ros_real import Graph

pytestmark = [pytest.mark.needs("rospy", "rostopic", "roslaunch")]

STRING = "std_msgs/String"


def command(kind: str, port: int) -> list[str]:
    if kind == "ours":
        return [str(Path(sys.executable).parent / "rce"), "core", "--port", str(port)]
    return ["/usr/bin/rosmaster", "--core", "-p", str(port)]


@pytest.mark.parametrize("kind", ["ours", "rosmaster"])
async def test_a_core_is_killed_and_started_again(
    kind: str, make_node: MakeGraphNode, tmp_path: Path
) -> None:
    port = free_port()
    graph = Graph(f"http://127.0.0.1:{port}/", tmp_path, kind)

    async def up() -> object:
        return await graph.ask("getPid")

    async def restored() -> bool:
        return "/talker" in await graph.publishers("/t") and await graph.service("/s") is not None

    async with (
        graph.program(*command(kind, port)) as core,
        make_node(graph, "talker", intra_process=False) as talker,
        make_node(graph, "listener", intra_process=False) as listener,
    ):
        publisher = await talker.advertise("t", STRING, latch=True)
        await talker.advertise_service("s", "std_srvs/Trigger", lambda _: {"success": True})
        heard = await listener.subscribe("t", STRING)
        await publisher.wait_for_subscribers(timeout=20)
        core.kill()
        await core.wait()
        assert await up() is None
        publisher.publish(data="nobody is master")
        assert (await asyncio.wait_for(anext(aiter(heard)), 20)).data == "nobody is master"
        async with graph.program(*command(kind, port)):
            await graph.until(up, what="the core is up again")
            await graph.until(restored, what="ours are known again")
            assert 'data: "nobody is master"' in await graph.tool("rostopic", "echo", "-n1", "/t")
            assert "success: True" in await graph.tool("rosservice", "call", "/s")
            publisher.publish(data="a new master")
            assert (await asyncio.wait_for(anext(aiter(heard)), 20)).data == "a new master"
            await talker.__aexit__(None, None, None)
            assert await graph.publishers("/t") == []
