"""The example nodes, each as a process."""

from __future__ import annotations

import asyncio

from support.processes import example

from rce.ros.core import Core


async def lines(process: asyncio.subprocess.Process, count: int) -> list[str]:
    assert process.stdout is not None
    async with asyncio.timeout(60):
        return [(await process.stdout.readline()).decode().strip() for _ in range(count)]


async def test_talker_and_listener(core: Core) -> None:
    argv = ("chatter:=/gossip",)
    async with example(core, "talker.py", *argv), example(core, "listener.py", *argv) as listener:
        heard = await lines(listener, 3)
        assert all(line.startswith("hello ") for line in heard)
        assert core.graph.topic_types["/gossip"] == "std_msgs/String"
    assert core.graph.nodes == {}


async def test_service(core: Core) -> None:
    async with example(core, "service_server.py"), example(core, "service_client.py") as client:
        assert await lines(client, 2) == ["False -> True", "True -> False"]
        await asyncio.wait_for(client.communicate(), 60)  # it ends by itself


async def test_parameters(core: Core) -> None:
    async with example(core, "parameters.py", "_gain:=2.5") as process:
        assert await lines(process, 3) == [
            "control: {'gain': 2.5, 'axes': ['x', 'y']}",
            "has /control/axes: True",
            "names: ['/control/gain']",
        ]
        await asyncio.wait_for(process.communicate(), 60)  # it ends by itself
