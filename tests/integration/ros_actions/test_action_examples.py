"""The example nodes of actions, each as a process."""

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
    """Run an example; at the end it is interrupted, if it still runs, and must leave cleanly."""
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
        await asyncio.wait_for(process.communicate(), 20)
        assert process.returncode == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


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
