"""The example nodes of actions, each as a process."""

from __future__ import annotations

import asyncio

from support.processes import example

from rce.ros.core import Core


async def test_server_and_client(core: Core) -> None:
    async with (
        example(core, "fibonacci_server.py", "_period:=0.05"),
        example(core, "fibonacci_client.py", "_order:=4") as client,
    ):
        output, _ = await asyncio.wait_for(client.communicate(), 40)
        lines = output.decode().splitlines()
        assert lines[0] == "so far: 0 1 1"
        assert lines[-2:] == ["result: 0 1 1 2 3", "ended: preempted"]
    assert core.graph.nodes == {}
