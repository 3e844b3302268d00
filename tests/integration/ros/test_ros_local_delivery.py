"""Messages between nodes of one process: the objects themselves, without connections."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from functools import partial

import pytest
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry
from rce.ros.xmlrpc import RpcClient

STRING = "std_msgs/String"


@pytest.fixture
def near(core: Core) -> MakeNode:
    return partial(Node, argv=[], master_uri=core.uri)


async def test_the_object_itself_is_delivered(near: MakeNode) -> None:
    types = TypeRegistry()
    async with near("a", types=types) as a, near("b", types=types) as b:
        got: asyncio.Queue[Message] = asyncio.Queue()
        raw: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await b.subscribe("t", STRING, got.put_nowait)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        message = publisher.type.new(data="hello")
        publisher.publish(message)
        assert got.empty(), "nothing is delivered within the call that publishes"
        assert await asyncio.wait_for(got.get(), 10) is message
        await b.subscribe_serialized("t", "*", lambda payload, latched: raw.put_nowait((payload, latched)))
        publisher.publish(message)
        assert await asyncio.wait_for(raw.get(), 10) == (b"\x05\0\0\0hello", False)
        assert await got.get() is message
        publisher.publish_serialized(bytearray(b"\x03\0\0\0raw"))
        assert await asyncio.wait_for(raw.get(), 10) == (b"\x03\0\0\0raw", False)
        assert (await got.get()).data == "raw"
        publisher.publish({"data": "mapping"})
        assert (await asyncio.wait_for(got.get(), 10)).data == "mapping"


async def test_near_and_far_subscribers_get_the_same(core: Core, near: MakeNode) -> None:
    async with near("a") as a, near("b") as b, near("far", intra_process=False) as far:
        publisher = await a.advertise("t", STRING, latch=True)
        nearby, distant = await b.subscribe("t", STRING), await far.subscribe("t", STRING)
        await publisher.wait_for_subscribers(2, timeout=10)
        assert publisher.connections == 2
        publisher.publish(publisher.type.new(data="one"))
        publisher.publish(data="two")
        for subscriber in (nearby, distant):
            async with asyncio.timeout(60):
                assert [(await anext(aiter(subscriber))).data for _ in range(2)] == ["one", "two"]
        late, later = await b.subscribe("t", STRING), await b.subscribe_serialized("t", "*", lambda *_: None)
        assert (await asyncio.wait_for(anext(aiter(late)), 10)).data == "two"
        await later.close()
        async with RpcClient() as rpc:
            _, _, info = await rpc.call(b.uri, "getBusInfo", ("/x",))
            assert [entry[1:5] for entry in info] == [[a.uri, "i", "INTRAPROCESS", "/t"]]
            _, _, (published, _, _) = await rpc.call(a.uri, "getBusStats", ("/x",))
            assert [[link[2] for link in entry[2]] for entry in published if entry[0] == "/t"] == [[2, 2]]


async def test_a_late_node_gets_the_latched_message(near: MakeNode) -> None:
    async with near("a") as a, near("b") as b:
        publisher = await a.advertise("t", STRING, latch=True)
        publisher.publish(data="kept")
        heard: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await b.subscribe_serialized("t", STRING, lambda *message: heard.put_nowait(message))
        assert await asyncio.wait_for(heard.get(), 10) == (b"\x04\0\0\0kept", True)


async def test_too_many_at_once_lose_the_oldest(near: MakeNode) -> None:
    async with near("a") as a:
        publisher = await a.advertise("t", STRING, queue_size=3)
        subscriber = await a.subscribe("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        for number in range(10):
            publisher.publish(data=str(number))
        async with asyncio.timeout(60):
            assert [(await anext(aiter(subscriber))).data for _ in range(3)] == ["7", "8", "9"]
        assert publisher.dropped == 7


async def test_objects_count_in_the_bytes_of_queues(near: MakeNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that takes nothing must not fill the memory, although its messages are never written."""
    monkeypatch.setattr("rce.ros.node.subscriber.MAX_QUEUED_BYTES", 10_000)
    monkeypatch.setattr("rce.ros.node.local.MAX_QUEUED_BYTES", 10_000)
    async with near("a") as a, near("b") as b:
        publisher = await a.advertise("t", "std_msgs/UInt8MultiArray", queue_size=1000)
        slow = await b.subscribe("t", "std_msgs/UInt8MultiArray", queue_size=1000)
        await publisher.wait_for_subscribers(timeout=10)
        for _ in range(20):
            publisher.publish(publisher.type.new(data=bytes(3000)))
        assert publisher.dropped == 17, "three wait for the event loop"
        for _ in range(20):
            publisher.publish(publisher.type.new(data=bytes(3000)))
            await asyncio.sleep(0)
        async with asyncio.timeout(20):
            while slow.dropped < 19:  # of 22 that were handed over; three wait for the program
                await asyncio.sleep(0)


async def test_types_must_agree(near: MakeNode, caplog: pytest.LogCaptureFixture) -> None:
    async with near("a") as a, near("b") as b:
        publisher = await a.advertise("t", STRING)
        wrong = await b.subscribe("t", "std_msgs/Bool")
        with pytest.raises(TimeoutError):
            await wrong.wait_for_publishers(timeout=0.2)
        assert "md5 sum" in caplog.text
        assert publisher.connections == 0


async def test_publishers_come_and_go(near: MakeNode) -> None:
    async with near("b") as b:
        subscriber = await b.subscribe("t", STRING)
        for incarnation in ("first", "second"):
            async with near("a") as a:
                publisher = await a.advertise("t", STRING)
                await publisher.wait_for_subscribers(timeout=10)
                publisher.publish(data=incarnation)
                assert (await asyncio.wait_for(anext(aiter(subscriber)), 10)).data == incarnation
        await subscriber.close()
        async with near("a") as a:
            publisher = await a.advertise("t", STRING)
            assert publisher.connections == 0


async def test_publisher_that_leaves_without_a_core_is_gone() -> None:
    """Its subscribers in this process have no connection that would end."""
    async with AsyncExitStack() as listening:
        async with Core(port=0) as core, AsyncExitStack() as talking:
            a, b = (Node(name, argv=[], master_uri=core.uri) for name in ("a", "b"))
            await listening.enter_async_context(b)
            heard = await b.subscribe("t", STRING)
            await talking.enter_async_context(a)
            publisher = await a.advertise("t", STRING)
            await heard.wait_for_publishers(timeout=10)
            publisher.publish(data="last")
            leaving = talking.pop_all()
        await leaving.aclose()
        async with asyncio.timeout(10):
            assert (await anext(aiter(heard))).data == "last"
            while heard.connections:
                await asyncio.sleep(0.01)
