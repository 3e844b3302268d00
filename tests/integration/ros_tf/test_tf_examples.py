"""The example nodes of tf, each as a process."""

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


async def test_broadcaster_and_listener(core: Core) -> None:
    argv = ("_tf_prefix:=robot1",)
    async with example(core, "tf_broadcaster.py", *argv), example(core, "tf_listener.py", *argv) as listener:
        assert listener.stdout is not None
        line = (await asyncio.wait_for(listener.stdout.readline(), 40)).decode()
        assert line.startswith("robot1/laser at x=")
        x, y = (float(part.partition("=")[2].removesuffix(" m")) for part in line.split(",")[:2])
        assert 2.0 < (x * x + y * y) ** 0.5 < 2.05
    assert core.graph.nodes == {}
