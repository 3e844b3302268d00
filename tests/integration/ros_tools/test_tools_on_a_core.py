"""``python -m rce.ros.tools`` as a program, on a core of ours with nodes in it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rce.ros import names
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry

pytestmark = pytest.mark.timeout(120)


async def start(core: Core, *words: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce.ros.tools", *words),
        env={**os.environ, "ROS_MASTER_URI": core.uri, "COLUMNS": "200"},
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )


async def tool(core: Core, *words: str, code: int = 0) -> str:
    process = await start(core, *words)
    output, _ = await process.communicate()
    assert process.returncode == code, output.decode()
    return output.decode()


@asynccontextmanager
async def talking() -> AsyncIterator[tuple[Core, Node]]:
    async with Core("127.0.0.1", 0) as core, Node("talker", argv=[], master_uri=core.uri) as node:
        publisher = await node.advertise("chat", "std_msgs/String", latch=True)
        publisher.publish(data="hello")
        yield core, node


async def test_topics_are_listed_and_read() -> None:
    async with talking() as (core, _):
        assert "/chat [std_msgs/String] 1 pub, 0 sub\n" in await tool(core, "topic", "list", "-v")
        assert await tool(core, "topic", "type", "chat") == "std_msgs/String\n"
        assert " * /talker\n" in await tool(core, "topic", "info", "/chat")
        assert await tool(core, "topic", "echo", "/chat", "-n", "1") == "{data: hello}\n---\n"
        assert json.loads(await tool(core, "topic", "echo", "/chat", "-n", "1", "--json")) == {
            "data": "hello"
        }


async def test_a_type_that_no_package_has_is_asked_of_its_publisher() -> None:
    own = TypeRegistry()
    kind = own.from_definition("my_msgs/Odd", "uint8 level\nstring why\n")
    async with (
        Core("127.0.0.1", 0) as core,
        Node("odd", argv=[], master_uri=core.uri, types=own) as node,
    ):
        publisher = await node.advertise("odd", kind, latch=True)
        publisher.publish(level=3, why="because")
        assert await tool(core, "topic", "echo", "/odd", "-n", "1") == "{level: 3, why: because}\n---\n"
        await publisher.close()
        text = await tool(core, "topic", "echo", "/odd", "-n", "1", code=1)
        assert "topic list" in text


async def test_messages_are_published() -> None:
    async with Core("127.0.0.1", 0) as core, Node("ear", argv=[], master_uri=core.uri) as node:
        heard = await node.subscribe("in", "std_msgs/String")
        await tool(core, "topic", "pub", "/in", "std_msgs/String", "hi")
        assert (await anext(heard)).data == "hi"
        await tool(core, "topic", "pub", "/in", "", "{data: again}")
        assert (await anext(heard)).data == "again"
        process = await start(core, "topic", "pub", "/in", "std_msgs/String", "x", "--rate", "50")
        for _ in range(5):
            assert (await anext(heard)).data == "x"
        process.send_signal(signal.SIGINT)
        output, _ = await process.communicate()
        assert process.returncode == 0, output.decode()


async def test_an_interrupted_command_tells_that_it_was_not_done() -> None:
    called = asyncio.Event()

    async def hang(_: Message) -> dict[str, object]:
        called.set()
        await asyncio.Event().wait()
        return {}

    async with talking() as (core, node):
        await node.advertise_service("switch", "std_srvs/SetBool", hang)
        call = await start(core, "service", "call", "/switch", "true")
        await asyncio.wait_for(called.wait(), 60)
        call.send_signal(signal.SIGINT)
        output, _ = await call.communicate()
        assert call.returncode == 130, output.decode()
        echo = await start(core, "topic", "echo", "/chat")
        assert echo.stdout is not None
        await echo.stdout.readline()
        echo.send_signal(signal.SIGINT)
        await echo.communicate()
        assert echo.returncode == 0


async def test_a_rate_is_shown() -> None:
    async with Core("127.0.0.1", 0) as core, Node("beat", argv=[], master_uri=core.uri) as node:
        publisher = await node.advertise("beat", "std_msgs/Empty")
        timer = node.timer(0.02, lambda _: publisher.publish())
        text = await tool(core, "topic", "hz", "/beat", "-n", "4", "--interval", "0.5")
        timer.stop()
        assert "average rate: " in text
        assert "Hz" in text


async def test_services_and_parameters() -> None:
    async with Core("127.0.0.1", 0) as core, Node("brain", argv=[], master_uri=core.uri) as node:
        await node.advertise_service(
            "switch", "std_srvs/SetBool", lambda on: {"success": on.data, "message": "ok"}
        )
        assert "/switch\n" in await tool(core, "service", "list")
        assert await tool(core, "service", "type", "/switch") == "std_srvs/SetBool\n"
        assert await tool(core, "service", "call", "/switch", "true") == "{success: true, message: ok}\n"
        assert "data" in await tool(core, "service", "call", "/switch", "{data: 7}", code=1)
        assert "no node provides" in await tool(core, "service", "call", "/nothing", code=1)
        await tool(core, "param", "set", "/a", "{b: [1, 2], c: x}")
        assert json.loads(await tool(core, "param", "get", "/a", "--json")) == {"b": [1, 2], "c": "x"}
        assert await tool(core, "param", "list", "/a") == "/a/b\n/a/c\n"
        await tool(core, "param", "delete", "/a/b")
        assert await tool(core, "param", "get", "/a") == "{c: x}\n"
        assert "not set" in await tool(core, "param", "get", "/a/b", code=1)
        assert "is not a value" in await tool(core, "param", "set", "/a", "", code=1)


async def test_listed_names_that_are_not_legal_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of others use such names, and masters take them."""
    monkeypatch.setattr(names, "is_graph_name", lambda _: True)  # as for nodes of others; not for the tool
    async with Core("127.0.0.1", 0) as core, Node("camera", argv=[], master_uri=core.uri) as node:
        publisher = await node.advertise("/camera-1/image", "std_msgs/String", latch=True)
        publisher.publish(data="hello")
        await node.advertise_service("/camera-1/on", "std_srvs/Empty", lambda _: {})
        await node.set_param("/gains/arm-left", 3)
        assert "/camera-1/image\n" in await tool(core, "topic", "list")
        assert " * /camera\n" in await tool(core, "topic", "info", "/camera-1/image")
        assert await tool(core, "topic", "echo", "/camera-1/image", "-n", "1") == "{data: hello}\n---\n"
        assert await tool(core, "topic", "hz", "/camera-1/image", "-n", "1", "--interval", "0.1")
        assert await tool(core, "service", "call", "/camera-1/on") == "{}\n"
        assert await tool(core, "param", "list", "/gains/") == "/gains/arm-left\n"
        assert await tool(core, "param", "get", "/gains/arm-left") == "3\n"
        await tool(core, "param", "set", "/gains/arm-left", "4")
        assert core.get_param("/gains/arm-left") == 4
        await tool(core, "param", "delete", "/gains/arm-left")
        assert not await node.has_param("/gains/arm-left")
        assert "not a legal" in await tool(core, "param", "get", "arm-left", code=1)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("topic", "echo", "/nope"), "no node publishes it"),
        (("topic", "pub", "/x", "std_msgs/Int32", "{data: 1.5}"), "int32"),
        (("topic", "pub", "/x", "std_msgs/Strin", "x"), "unknown type std_msgs/Strin"),
        (("topic", "pub", "/x", "std_msgs/String", "{dta: x}"), "no such field"),
    ],
)
async def test_faults_are_told_in_one_line(words: tuple[str, ...], expected: str) -> None:
    async with Core("127.0.0.1", 0) as core:
        text = await tool(core, *words, code=1)
        assert expected in text
        assert text.count("\n") == 1
        assert "Traceback" not in text
