"""A node reads its parameters from a real parameter server and reports problems on /rosout."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from rce.ros.core import Core
from rce.ros.node import Node
from rce_fleet.nodes.parameters import read_parameters


@dataclass(frozen=True)
class Settings:
    rate: float = field(default=10.0, metadata={"above": 0.0})
    frame: str = "map"
    tf_prefix: str = field(default="", metadata={"search": True})


async def test_problems_are_on_rosout_and_the_node_lives() -> None:
    async with Core(port=0) as core, Node("judge", argv=[], master_uri=core.uri) as judge:
        heard: asyncio.Queue[tuple[int, str]] = asyncio.Queue()

        def take(message: object) -> None:
            if getattr(message, "name", "") == "/Robot1/amcl":
                heard.put_nowait((message.level, message.msg))  # type: ignore[attr-defined]

        await judge.subscribe("/rosout", "rosgraph_msgs/Log", take)
        await judge.set_param("/Robot1/tf_prefix", "Robot1")
        await judge.set_param("/Robot1/amcl", {"rate": -1, "fram": "x", "other": {"rate": 3}})
        async with Node("amcl", namespace="Robot1", argv=["_frame:=odom"], master_uri=core.uri) as node:
            settings = await read_parameters(node, Settings)
            texts = [await asyncio.wait_for(heard.get(), 60) for _ in range(2)]
    assert settings == Settings(frame="odom", tf_prefix="Robot1")
    assert sorted(texts) == [
        (4, "unknown parameter /Robot1/amcl/fram; did you mean /Robot1/amcl/frame?"),
        (8, "parameter /Robot1/amcl/rate is -1, must be greater than 0.0; 10.0 is used"),
    ]
