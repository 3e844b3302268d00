"""A client that knows only the protocol page gets its string back, by topic and by service."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from support.engine import Engine, running_engine, until
from support.stranger import TIMEOUT_S, check_echo, stranger, wire_echo

from rce_client.connection import Connection

pytestmark = [pytest.mark.e2e, pytest.mark.asyncio(loop_scope="module")]

RUNTIMES = ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))]
IN_PROCESSES = pytest.mark.parametrize("shared_engine", ["process"], indirect=True, scope="module")
STRING = "std_msgs/String"


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=RUNTIMES)
async def shared_engine(request: pytest.FixtureRequest) -> AsyncIterator[Engine]:
    async with running_engine(runtime=request.param) as engine:
        yield engine


@pytest_asyncio.fixture(autouse=True, loop_scope="module")
async def _no_robots(shared_engine: Engine) -> None:
    await until(shared_engine.has_no_robots, what="the robots of other tests left")


async def test_echo_by_topic_and_service(shared_engine: Engine) -> None:
    async with stranger(shared_engine.url) as client:
        await wire_echo(client)
        await check_echo(client, "grüezi")
        await check_echo(client, "x" * 100_000)
        assert client.errors == []
        await client.send("DC", {"containerTag": "cTag_01"})
        await client.wait_status(dict.fromkeys(("requestIn", "responseOut", "serviceIn"), False))


@IN_PROCESSES
async def test_faults_are_told_and_nothing_else_is_lost(shared_engine: Engine) -> None:
    async with stranger(shared_engine.url) as client:
        await client.socket.send_str("no json")
        await client.send("XY", {})
        await client.send(
            "CN", {"addNodes": [{"containerTag": "nowhere", "nodeTag": "n", "pkg": "Test", "exe": "x"}]}
        )
        await client.wait_error("nowhere")
        await wire_echo(client)
        before = len(client.errors)
        await client.publish("unknownTag", "std_msgs/String", {"data": "a"})
        await client.wait_error("unknownTag")
        await client.publish("requestIn", "std_msgs/Int32", {"data": 1})
        await client.wait_error("std_msgs/Int32")
        await client.publish("requestIn", "std_msgs/String", {"data": 7})
        await client.wait_error("data")
        await client.send(
            "CN",
            {
                "addNodes": [
                    {"containerTag": "cTag_01", "nodeTag": "bad", "pkg": "NoSuchPackage", "exe": "x"},
                    {"containerTag": "cTag_01", "nodeTag": "bad2", "pkg": "Test", "exe": "noSuchFile"},
                ]
            },
        )
        await client.wait_error("NoSuchPackage")
        await client.wait_error("noSuchFile")
        assert len(client.errors) >= before + 5
        await check_echo(client, "still here")
        await client.send("DC", {"containerTag": "cTag_01"})


@IN_PROCESSES
async def test_echo_in_one_frame_beside_two_frame_client(shared_engine: Engine) -> None:
    """Both are connected to one container's topics; a client that did not ask sees nothing new."""
    text = struct.pack("<I", 5) + b"hello"
    topics = (("say", "Publisher", "/stringEchoReq"), ("hear", "Subscriber", "/stringEchoResp"))
    async with (
        Connection(shared_engine.url, "testUser", "testUser", "asking") as asking,
        stranger(shared_engine.url, robot="plain") as plain,
    ):
        assert asking.takes_single_frames
        await asking.create_container("box")
        await asking.add_node("box", "echo", "Test", "stringEcho.py")
        got: asyncio.Queue[bytes] = asyncio.Queue()
        publisher = await asking.publisher("say", STRING, raw=True)
        await asking.subscriber("hear", STRING, lambda message: got.put_nowait(bytes(message)), raw=True)
        for tag, role, topic in topics:
            await asking.add_interface("box", tag, f"{role}Interface", STRING, addr=topic)
            await asking.connect(f"asking/{tag}", f"box/{tag}")
        for tag in ("say", "hear"):
            await asking.wait_active(tag, TIMEOUT_S)
        for tag, kind in (("say", "SubscriberForwarder"), ("hear", "PublisherForwarder")):
            own = {"endpointTag": "plain", "interfaceTag": tag, "interfaceType": kind, "className": STRING}
            await plain.send("CN", {"addInterfaces": [own]})
            await plain.send("CX", {"connect": [{"tagA": f"plain/{tag}", "tagB": f"box/{tag}"}]})
        await plain.wait_status({"say": True, "hear": True})
        publisher.publish(text)
        assert await got.get() == text
        assert await plain.receive("hear") == text
        id_ = "0" * 32
        await plain.send("DM", {"iTag": "say", "type": STRING, "msgID": "nil", "msg*": id_})
        await plain.socket.send_bytes(id_.encode() + text)
        assert await plain.receive("hear") == text
        assert await got.get() == text
        assert plain.errors == []
        await asking.remove_all()
