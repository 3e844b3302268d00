"""``rce-ros`` between a real ROS graph and an engine."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from typing import TYPE_CHECKING, Any

import pytest
from support.client_types import ros_string
from support.processes import finish

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import TypeRegistry
from rce.ros.xmlrpc import RpcClient
from rce_client.ros_bridge.bridge import joined_graph

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from integration.client.conftest import Engine

STRING = "std_msgs/String"
EMPTY = "std_srvs/SetBool"


def config(url: str) -> dict[str, Any]:
    own = [
        ("say", "SubscriberConverter", STRING, "/say"),
        ("hear", "PublisherForwarder", STRING, "/hear"),
        ("ask", "ServiceProviderConverter", EMPTY, "/ask"),
        ("serve", "ServiceClientForwarder", EMPTY, "/serve"),
    ]
    return {
        "url": url,
        "userID": "testUser",
        "password": "testUser",
        "robotID": "testRobot",
        "containers": [{"cTag": "c1"}],
        "interfaces": [
            *({"eTag": "testRobot", "iTag": t, "iType": k, "iCls": c, "addr": a} for t, k, c, a in own),
            {"eTag": "c1", "iTag": "say", "iType": "PublisherInterface", "iCls": STRING, "addr": "/say"},
        ],
        "connections": [{"tagA": f"testRobot/{t}", "tagB": f"other/{t}"} for t, *_ in own[1:]]
        + [{"tagA": "testRobot/say", "tagB": "c1/say"}],
    }


class Program:
    """``rce-ros`` as a process, its lines read as they come."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.lines: list[str] = []

    async def until(self, text: str) -> str:
        assert self.process.stdout is not None
        async with asyncio.timeout(30):
            while True:
                line = (await self.process.stdout.readline()).decode()
                assert line, f"ended before {text!r}: {self.lines}"
                self.lines.append(line)
                if text in line:
                    return line

    async def end(self) -> int:
        assert self.process.stdout is not None
        async with asyncio.timeout(30):
            self.lines += (await self.process.stdout.read()).decode().splitlines()
            return await self.process.wait()


@contextlib.asynccontextmanager
async def program(*arguments: str, master: str = "http://127.0.0.1:1/") -> AsyncIterator[Program]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "rce_client.ros_bridge",
        *arguments,
        env={**os.environ, "ROS_MASTER_URI": master},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    try:
        yield Program(process)
    finally:
        await finish(process)


def write(folder: Path, data: object) -> str:
    path = folder / "robot.config"
    path.write_text(json.dumps(data))
    return str(path)


async def test_messages_and_calls_pass_both_ways(engine: Engine, tmp_path: Path) -> None:
    """Messages and calls pass both ways and everything is removed."""
    path = write(tmp_path, config(engine.door.url))
    async with Core(host="127.0.0.1", port=0) as core, program(path, master=core.uri) as bridge:
        assert "rce-ros ready: robot testRobot connected" in await bridge.until("ready")
        types = {item["interfaceType"] for item in made(engine) if item["endpointTag"] == "testRobot"}
        assert all(type_.endswith("Forwarder") for type_ in types)
        async with Node("robot", argv=(), master_uri=core.uri) as node:
            publisher = await node.advertise("/say", STRING)
            await publisher.wait_for_subscribers(1, timeout=10)
            publisher.publish(data="up")
            assert await engine.end("say").received.get() == ros_string("up")

            heard: asyncio.Queue[str] = asyncio.Queue()
            subscriber = await node.subscribe("/hear", STRING, lambda message: heard.put_nowait(message.data))
            async with asyncio.timeout(60):
                while not subscriber.connections:
                    await asyncio.sleep(0.01)
            engine.end("hear").port.send(ros_string("down"))
            assert await heard.get() == "down"

            async def cloud_answers(payload: bytes) -> bytes:
                assert payload == b"\x01"
                return b"\x01" + ros_string("cloud")

            engine.end("ask").answer = cloud_answers
            answer = await node.service_client("/ask", EMPTY)(data=True)
            assert (answer.success, answer.message) == (True, "cloud")

            await node.advertise_service("/serve", EMPTY, lambda request: {"message": f"got {request.data}"})
            called = await engine.end("serve").port.call(b"\x01")
            assert called == b"\x00" + ros_string("got True")
        engine.master.requests.clear()
        bridge.process.send_signal(signal.SIGINT)
        assert await bridge.end() == 0
    await engine.master.changed.until(lambda: len(engine.master.requests) == 3)
    assert [type_ for _, type_, _ in engine.master.requests] == ["CX", "CN", "DC"]
    removed = engine.master.requests[1][2]["removeInterfaces"]
    assert {item["interfaceTag"] for item in removed} == {"say", "hear", "ask", "serve"}


def made(engine: Engine) -> list[dict[str, str]]:
    return [item for _, _, data in engine.master.requests for item in data.get("addInterfaces", ())]


async def test_another_of_its_name_takes_its_place(engine: Engine, tmp_path: Path) -> None:
    """The ROS master tells the first to stop: it ends, so that the second gets the robot's place."""
    path = write(tmp_path, config(engine.door.url))
    async with (
        Core(host="127.0.0.1", port=0) as core,
        program(path, master=core.uri) as first,
    ):
        await first.until("rce-ros ready")
        async with program(path, master=core.uri) as second:
            await first.until("the robot's ROS graph told this program to stop")
            assert await first.end() == 0
            await second.until("rce-ros ready")


async def test_ends_when_its_node_is_killed_in_the_graph(engine: Engine, tmp_path: Path) -> None:
    """As by Ctrl-C, also while it waits for a robotID that is in use, which it says every few seconds."""
    path = write(tmp_path, config(engine.door.url))
    async with (
        engine.connection(),
        Core(host="127.0.0.1", port=0) as core,
        program(path, master=core.uri) as bridge,
    ):
        for _ in range(2):
            await bridge.until("the robotID is in use")
        async with RpcClient() as rpc:
            _, _, uri = await rpc.call(core.uri, "lookupNode", ("/test", "/rce_ros_testRobot"))
            await rpc.call(uri, "shutdown", ("/rosnode-1", "user request"))
        await bridge.until("the robot's ROS graph told this program to stop")
        assert await bridge.end() == 0


async def test_errors_of_the_engine_are_shown(engine: Engine, tmp_path: Path) -> None:
    engine.refuse["say"] = "say: no room"
    path = write(tmp_path, config(engine.door.url))
    async with Core(host="127.0.0.1", port=0) as core, program(path, master=core.uri) as bridge:
        await bridge.until("engine: say: no room")
        bridge.process.terminate()
        assert await bridge.end() == 0


async def test_waits_for_the_robots_master(engine: Engine, tmp_path: Path) -> None:
    async with program(write(tmp_path, config(engine.door.url))) as bridge:
        await bridge.until("waiting for the robot's ROS master at http://127.0.0.1:1/")
        assert not engine.master.inside
        bridge.process.send_signal(signal.SIGINT)
        assert await bridge.end() == 0


async def test_a_refusal_ends_the_program(engine: Engine, tmp_path: Path) -> None:
    data = config(engine.door.url) | {"password": "wrong"}
    path = write(tmp_path, data)
    async with Core(host="127.0.0.1", port=0) as core, program(path, master=core.uri) as bridge:
        assert await bridge.end() == 1
        assert "Wrong user or password" in "".join(bridge.lines)


async def test_bad_file_is_refused_with_every_fault(engine: Engine, tmp_path: Path) -> None:
    """A bad file is refused with every fault and nothing is sent."""
    data = config(engine.door.url)
    for number in (1, 2):
        data["interfaces"][number] |= {"iCls": f"no_such/Type{number}"}
    async with program(write(tmp_path, data)) as bridge:
        assert await bridge.end() == 2
    text = "\n".join(bridge.lines)
    assert "interfaces[2].iCls" in text
    assert "interfaces[1].iCls" in text
    data["interfaces"][2]["iType"] = "Nonsense"
    del data["userID"]
    async with program(write(tmp_path, data)) as bridge:
        assert await bridge.end() == 2
    text = "\n".join(bridge.lines)
    assert "interfaces[2].iType" in text
    assert "userID" in text
    assert not engine.door.targets


async def test_check_only_tells_what_is_in_the_file(engine: Engine, tmp_path: Path) -> None:
    async with program(write(tmp_path, config(engine.door.url)), "--check") as bridge:
        assert await bridge.end() == 0
    text = "\n".join(bridge.lines)
    assert "testRobot of user testUser" in text
    assert "say: topic /say to the cloud, std_msgs/String" in text
    assert not engine.door.targets


async def test_joined_graph_takes_the_master_when_it_comes() -> None:
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rce_client.ros_bridge.bridge.MASTER_TIMEOUT", 0.05)
        async with Core(host="127.0.0.1", port=0) as core:
            uri = core.uri
        waiting = asyncio.Event()

        def say(text: str) -> None:
            said.append(text)
            waiting.set()

        async def join() -> None:
            async with joined_graph("r", uri, TypeRegistry(), say):
                pass

        task = asyncio.create_task(join())
        await waiting.wait()
        async with Core(host="127.0.0.1", port=int(uri.rstrip("/").rpartition(":")[2])):
            await task
    assert uri in said[0]
