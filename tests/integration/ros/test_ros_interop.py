"""Real ROS (rospy and the command line tools) at our core, with our nodes at the other end."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support.processes import finish
from support.ros_nodes import MakeNode, say_until_echoed

from rce.ros.core import Core
from rce.ros.errors import ServiceFaultError
from rce.ros.types import Message

pytestmark = pytest.mark.needs("rospy")

STRING = "std_msgs/String"

ROSPY_NODE = """
import rospy
from std_msgs.msg import String
from roscpp.srv import SetLoggerLevel, SetLoggerLevelResponse

def set_level(request):
    if request.logger == "fail":
        raise rospy.ServiceException("as asked")
    rospy.set_param("/level", request.level)
    return SetLoggerLevelResponse()

rospy.init_node("real")
echo = rospy.Publisher("echo", String, queue_size=10)
latched = rospy.Publisher("latched", String, queue_size=1, latch=True)
latched.publish("kept " + rospy.get_param("~word"))
rospy.Subscriber("say", String, lambda message: echo.publish(message.data), buff_size=2**24)
rospy.Service("set_level", SetLoggerLevel, set_level)
rospy.logwarn("ready")
rospy.spin()
"""

SLOW_TO_LATCH = """
import time
import rospy
from rospy.topics import _PublisherImpl
from std_msgs.msg import String

enable_latch = _PublisherImpl.enable_latch

def enable_latch_late(self):
    time.sleep(1)
    enable_latch(self)

_PublisherImpl.enable_latch = enable_latch_late
rospy.init_node("slow")
publisher = rospy.Publisher("latched", String, queue_size=1, latch=True)
publisher.publish("kept")
rospy.spin()
"""
"""A rospy node that is registered a second before it latches; without the change it is a moment."""


def environment(core: Core) -> dict[str, str]:
    """What programs of a real ROS need; without this project's Python path."""
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    return kept | {"ROS_MASTER_URI": core.uri, "ROS_IP": "127.0.0.1", "PATH": "/usr/bin:/bin"}


@asynccontextmanager
async def rospy_node(core: Core, folder: Path, *argv: str) -> AsyncIterator[asyncio.subprocess.Process]:
    script = folder / "node.py"
    script.write_text(ROSPY_NODE)
    process = await asyncio.create_subprocess_exec(
        "/usr/bin/python3",
        str(script),
        *argv,
        env=environment(core) | {"HOME": str(folder)},
        start_new_session=True,
    )
    try:
        await core.wait_until(lambda graph: graph.service("/set_level") is not None, timeout=30)
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def tool(core: Core, *argv: str) -> str:
    """Run a command line tool; return what it prints."""
    process = await asyncio.create_subprocess_exec(
        *argv, env=environment(core), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    try:
        async with asyncio.timeout(60):
            output, _ = await process.communicate()
    finally:
        await finish(process)
    text = output.decode()
    assert process.returncode == 0, text
    return text


async def test_a_rospy_node_and_ours(core: Core, make_node: MakeNode, tmp_path: Path) -> None:
    async with make_node("ours") as ours, rospy_node(core, tmp_path, "_word:=word") as process:
        latched: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await ours.subscribe_serialized("latched", STRING, lambda *message: latched.put_nowait(message))
        payload, is_latched = await asyncio.wait_for(latched.get(), 20)
        assert (payload[4:], is_latched) == (b"kept word", True)

        echo = await ours.subscribe("echo", STRING)
        say = await ours.advertise("say", STRING)
        await say_until_echoed(say, echo)
        async with asyncio.timeout(30):
            for text in ("", "hello", "x" * 1_000_000, "ü" * 1000):
                say.publish(data=text)
                assert (await anext(aiter(echo))).data == text

        client = ours.service_client("set_level", "roscpp/SetLoggerLevel")
        await client.call({"logger": "x", "level": "warn"}, timeout=20)
        assert await ours.get_param("/level") == "warn"
        with pytest.raises(ServiceFaultError, match="as asked"):
            await client.call({"logger": "fail"}, timeout=20)
        loggers = await ours.service_client("/real/get_loggers", "roscpp/GetLoggers", persistent=False)()
        assert "rosout" in {logger.name for logger in loggers.loggers}

        await tool(core, "rosnode", "kill", "/real")
        await asyncio.wait_for(process.wait(), 20)
        await core.wait_until(lambda graph: "/real" not in graph.nodes, timeout=20)
        assert core.graph.service("/set_level") is None


async def test_a_newer_rospy_node_ends_the_older(core: Core, tmp_path: Path) -> None:
    async with rospy_node(core, tmp_path, "_word:=one") as older:
        core_saw = core.graph.nodes["/real"]
        async with rospy_node(core, tmp_path, "_word:=two"):
            await core.wait_until(lambda graph: graph.nodes.get("/real", core_saw) != core_saw, timeout=20)
            await asyncio.wait_for(older.wait(), 20)


async def test_topic_tools_see_our_nodes(core: Core, make_node: MakeNode) -> None:
    async with make_node("ours", namespace="robot") as ours:
        said: asyncio.Queue[str] = asyncio.Queue()
        await ours.subscribe("heard", STRING, lambda message: said.put_nowait(message.data))
        publisher = await ours.advertise("said", STRING, latch=True)
        publisher.publish(data="hello tools")
        assert set((await tool(core, "rostopic", "list")).split()) == {
            "/robot/heard",
            "/robot/said",
            "/rosout",
        }
        info = await tool(core, "rostopic", "info", "/robot/said")
        assert "Type: std_msgs/String" in info
        assert "/robot/ours" in info
        assert 'data: "hello tools"' in await tool(core, "rostopic", "echo", "-n1", "/robot/said")
        publish = asyncio.create_task(tool(core, "rostopic", "pub", "-1", "/robot/heard", STRING, "hi"))
        assert await asyncio.wait_for(said.get(), 30) == "hi"
        await publish
        assert "/robot/ours" in await tool(core, "rosnode", "list")
        node = await tool(core, "rosnode", "info", "/robot/ours")
        assert "* /robot/said [std_msgs/String]" in node
        assert f"Pid: {os.getpid()}" in node
        assert "xmlrpc reply from" in await tool(core, "rosnode", "ping", "-c", "2", "/robot/ours")


async def test_service_tools_call_our_nodes(core: Core, make_node: MakeNode) -> None:
    async with make_node("ours") as ours:

        async def loggers(request: Message) -> dict[str, Any]:
            return {"loggers": [{"name": "a", "level": "info"}, {"name": "b", "level": "debug"}]}

        def refuse(request: Message) -> None:
            raise ServiceFaultError("/refuse", "never")

        await ours.advertise_service("get", "roscpp/GetLoggers", loggers)
        await ours.advertise_service("refuse", "roscpp/Empty", refuse)
        assert "/get" in await tool(core, "rosservice", "list")
        assert (await tool(core, "rosservice", "type", "/get")).strip() == "roscpp/GetLoggers"
        assert "/ours" in await tool(core, "rosservice", "node", "/get")
        answer = await tool(core, "rosservice", "call", "/get")
        assert 'name: "b"' in answer
        with pytest.raises(AssertionError, match="never"):
            await tool(core, "rosservice", "call", "/refuse")


async def test_parameter_tools(core: Core, make_node: MakeNode, tmp_path: Path) -> None:
    async with make_node("ours") as ours:
        await tool(core, "rosparam", "set", "/tree", "{a: 1, b: [1, 2.5, x], c: {d: true}}")
        assert await ours.get_param("/tree") == {"a": 1, "b": [1, 2.5, "x"], "c": {"d": True}}
        await ours.set_param("/tree/a", "text")
        assert (await tool(core, "rosparam", "get", "/tree/a")).strip() == "text"
        file = tmp_path / "dump.yaml"
        await tool(core, "rosparam", "dump", str(file), "/tree")
        await tool(core, "rosparam", "delete", "/tree")
        assert not await ours.has_param("/tree")
        await tool(core, "rosparam", "load", str(file), "/back")
        assert await ours.get_param("/back/c/d") is True
        assert "/back/a" in await tool(core, "rosparam", "list")
        assert "noetic" in await tool(core, "rosparam", "get", "/rosdistro")


async def test_rospy_publisher_that_was_connected_before_it_latched(
    core: Core, make_node: MakeNode, tmp_path: Path
) -> None:
    script = tmp_path / "slow.py"
    script.write_text(SLOW_TO_LATCH)
    async with make_node("ours") as ours:
        heard: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        subscriber = await ours.subscribe_serialized(
            "latched", STRING, lambda *message: heard.put_nowait(message)
        )
        process = await asyncio.create_subprocess_exec(
            "/usr/bin/python3",
            str(script),
            env=environment(core) | {"HOME": str(tmp_path)},
            start_new_session=True,
        )
        try:
            await subscriber.wait_for_publishers(timeout=30)
            assert heard.empty(), "the publisher is not connected before it latches"
            payload, is_latched = await asyncio.wait_for(heard.get(), 30)
            assert (payload[4:], is_latched) == (b"kept", True)
            await asyncio.sleep(0.2)
            assert heard.empty()
        finally:
            await finish(process)
