"""The nodes of ``topic_tools`` that come with the project, as processes, with their own arguments."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rce.ros.core import Core
from rce.ros.node import Node, Subscriber
from rce.ros.packages import PackageIndex

WAIT_S = 60.0


@pytest.fixture
async def core() -> AsyncIterator[Core]:
    async with Core(port=0) as core:
        yield core


@asynccontextmanager
async def tool(core: Core, name: str, *words: str) -> AsyncIterator[asyncio.subprocess.Process]:
    command = PackageIndex([]).find("topic_tools").executable(name)
    process = await asyncio.create_subprocess_exec(
        *command, *words, env={**os.environ, "ROS_MASTER_URI": core.uri}, stderr=asyncio.subprocess.PIPE
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
        await process.communicate()


async def data_of(subscriber: Subscriber) -> str:
    async with asyncio.timeout(WAIT_S):
        message = await anext(aiter(subscriber))
    return str(message.data)


async def test_relay_publishes_under_another_name(core: Core) -> None:
    async with Node("judge", argv=[], master_uri=core.uri) as judge:
        source = await judge.advertise("/amcl_pose", "std_msgs/String", latch=True)
        source.publish(data="here")
        named = await judge.subscribe("/Robot1/amcl_pose", "std_msgs/String")
        usual = await judge.subscribe("/amcl_pose_relay", "std_msgs/String")
        words = ("/amcl_pose", "out", "__ns:=/Robot1", "out:=amcl_pose", "__name:=posed")
        async with tool(core, "relay", *words), tool(core, "relay", "/amcl_pose"):
            assert await data_of(named) == "here"
            assert await data_of(usual) == "here"
            assert "/Robot1/posed" in core.graph.publishers("/Robot1/amcl_pose")


async def test_throttle_leaves_messages_out(core: Core) -> None:
    async with Node("judge", argv=[], master_uri=core.uri) as judge:
        source = await judge.advertise("/fast", "std_msgs/String")
        slow = await judge.subscribe("/slow", "std_msgs/String")
        async with tool(core, "throttle", "messages", "/fast", "0.001", "/slow"):
            arrived = asyncio.ensure_future(data_of(slow))
            # A connection alone does not show that the node takes messages: it opens one to learn the type.
            while not arrived.done():
                source.publish(data="early")
                await asyncio.sleep(0.02)
            assert await arrived == "early"
            for _ in range(20):
                source.publish(data="late")
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(anext(aiter(slow)), 0.3)


@pytest.mark.parametrize(
    ("name", "words"),
    [("relay", ()), ("throttle", ("messages", "/a")), ("throttle", ("messages", "/a", "fast"))],
)
async def test_wrong_arguments_are_refused(core: Core, name: str, words: tuple[str, ...]) -> None:
    async with tool(core, name, *words) as process:
        _, error = await asyncio.wait_for(process.communicate(), WAIT_S)
    assert process.returncode == 2
    assert error.startswith(b"usage: ")


async def test_a_topic_is_not_relayed_to_itself(core: Core) -> None:
    async with tool(core, "relay", "/a", "a") as process:
        _, error = await asyncio.wait_for(process.communicate(), WAIT_S)
    assert (process.returncode, error) == (1, b"relay: /a cannot be relayed to itself\n")
