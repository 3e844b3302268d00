"""The example nodes of tf, each as a process."""

from __future__ import annotations

import asyncio

from support.processes import example

from rce.ros.core import Core


async def test_broadcaster_and_listener(core: Core) -> None:
    argv = ("_tf_prefix:=robot1",)
    async with example(core, "tf_broadcaster.py", *argv), example(core, "tf_listener.py", *argv) as listener:
        assert listener.stdout is not None
        line = (await asyncio.wait_for(listener.stdout.readline(), 40)).decode()
        assert line.startswith("robot1/laser at x=")
        x, y = (float(part.partition("=")[2].removesuffix(" m")) for part in line.split(",")[:2])
        assert 2.0 < (x * x + y * y) ** 0.5 < 2.05
    assert core.graph.nodes == {}
