"""The example nodes, each as a process."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from rce.ros.core import Core

EXAMPLES = Path(__file__).parents[3] / "examples" / "ros"


@asynccontextmanager
async def example(core: Core, name: str, *argv: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run an example; at the end it is interrupted and must leave cleanly."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        str(EXAMPLES / name),
        *argv,
        env=os.environ | {"ROS_MASTER_URI": core.uri},
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
        if process.returncode is None:
            process.send_signal(signal.SIGINT)
            assert await asyncio.wait_for(process.wait(), 20) == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def lines(process: asyncio.subprocess.Process, count: int) -> list[str]:
    assert process.stdout is not None
    async with asyncio.timeout(30):
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
        assert await asyncio.wait_for(client.wait(), 20) == 0


async def test_parameters(core: Core) -> None:
    async with example(core, "parameters.py", "_gain:=2.5") as process:
        assert await lines(process, 3) == [
            "control: {'gain': 2.5, 'axes': ['x', 'y']}",
            "has /control/axes: True",
            "names: ['/control/gain']",
        ]
        assert await asyncio.wait_for(process.wait(), 20) == 0
