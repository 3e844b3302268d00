"""Host names that cannot be resolved: the commonest fault of ROS networks, told plainly and once."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest
from support.engine import Program, until
from support.resolvers import silent_resolver

from rce.ros.core import Core
from rce.ros.xmlrpc import RpcClient

pytestmark = pytest.mark.needs("netns")

STRING = "std_msgs/String"
HOST = "robot-without-a-name.example"
RELAY = "import typer; from rce.ros.cli.relay import relay; typer.run(relay)"


async def test_a_cancelled_lookup_leaves_no_exception(core: Core, tmp_path: Path) -> None:
    """The publisher goes while its name is still looked up, in a real subscriber on uvloop."""
    async with silent_resolver(tmp_path) as (resolver, asking), RpcClient() as rpc:
        subscriber = relay(asking, core, tmp_path)
        await register_publisher(rpc, core)
        await subscriber.start(ready="")
        try:
            async with asyncio.timeout(40):
                await resolver.asked.wait()
            (uri,) = (node for name, node in core.graph.nodes.items() if name.startswith("/relay"))
            assert (await rpc.call(uri, "publisherUpdate", ("/master", "/from", [])))[0] == 1
            for _ in range(5):
                await rpc.call(uri, "getPid", ("/test",))
            resolver.refuse_all()
            for _ in range(20):
                await rpc.call(uri, "getPid", ("/test",))
        finally:
            await subscriber.stop()
    assert "never retrieved" not in subscriber.output()
    assert "Traceback" not in subscriber.output()


async def test_an_unresolvable_publisher_is_told_once(core: Core, tmp_path: Path) -> None:
    """However often the subscriber tries again; the line names the variables that cure it."""
    async with silent_resolver(tmp_path) as (resolver, asking), RpcClient() as rpc:
        resolver.refuse_all()
        subscriber = relay(asking, core, tmp_path)
        await register_publisher(rpc, core)
        await subscriber.start(ready="")
        try:
            await until(lambda: resolver.names.count(HOST) >= 6, timeout=40, what="it is tried again")
            await until(lambda: "ROS_HOSTNAME" in subscriber.output(), timeout=10, what="it is told")
        finally:
            await subscriber.stop()
    (line,) = (line for line in subscriber.output().splitlines() if "cannot be resolved" in line)
    assert HOST in line
    assert "ROS_HOSTNAME or ROS_IP" in line
    assert "never retrieved" not in subscriber.output()


def relay(asking: list[str], core: Core, folder: Path) -> Program:
    argv = [*asking, sys.executable, "-c", RELAY, "/from", "/to", "--master-uri", core.uri]
    return Program("relay", argv, {"ROS_IP": "127.0.0.1", "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}, folder)


async def register_publisher(rpc: RpcClient, core: Core) -> None:
    """Register a publisher whose machine has a wrong ROS_HOSTNAME."""
    answer = await rpc.call(core.uri, "registerPublisher", ("/lost", "/from", STRING, f"http://{HOST}:4711/"))
    assert answer[0] == 1
