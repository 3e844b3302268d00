"""What a bridge hears of topics, and what it latches for others."""

from __future__ import annotations

import asyncio

import pytest
from support.ros_nodes import MakeNode, collect

STRING = "std_msgs/String"


@pytest.mark.parametrize("intra_process", [True, False])
async def test_a_bridge_hears_all_but_itself(make_node: MakeNode, intra_process: bool) -> None:
    """Whether another subscriber of the same node hears the node's own messages or not."""
    async with make_node("a", intra_process=intra_process) as a, make_node("b") as b:
        ear = Ear()
        bridge = await a.listen("t", STRING, ear)
        own = await a.advertise("t", STRING)
        other = await b.advertise("t", STRING)
        await other.wait_for_subscribers(timeout=20)
        assert own.connections == 0
        own.publish(data="own")
        subscriber = await a.subscribe("t", STRING)
        await subscriber.wait_for_publishers(2, timeout=20)
        own.publish(data="also own")
        assert await collect(subscriber, 1) == ["also own"]
        other.publish(data="other")
        assert await collect(subscriber, 1) == ["other"]
        assert await ear.next() == ("", other.type.serialize({"data": "other"}))
        assert ear.events.empty()
        assert bridge.connections == 2


class Ear:
    """A bridge's listener: notes what it is told, with the publisher of what is latched."""

    def __init__(self) -> None:
        self.events: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()

    def received(self, payload: bytes) -> None:
        self.events.put_nowait(("", payload))

    def received_latched(self, payload: bytes, source: str) -> None:
        self.events.put_nowait((source, payload))

    def source_ended(self, source: str) -> None:
        self.events.put_nowait((source, b""))

    async def next(self) -> tuple[str, bytes]:
        async with asyncio.timeout(60):
            return await self.events.get()


async def test_a_bridge_knows_whose_latched_message_is_whose(make_node: MakeNode) -> None:
    """One that ends takes its message back; another publisher's stays."""
    async with make_node("bridge") as bridge, make_node("a") as a:
        ear = Ear()
        publisher = await a.advertise("t", STRING, latch=True)
        publisher.publish(data="of a")
        async with make_node("b") as b:
            (await b.advertise("t", STRING, latch=True)).publish(data="of b")
            await bridge.listen("t", STRING, ear)
            found = dict([await ear.next(), await ear.next()])
            assert found == {
                node.uri: publisher.type.serialize({"data": f"of {n}"}) for n, node in (("a", a), ("b", b))
            }
            former = b.uri
        assert await ear.next() == (former, b"")
        publisher.publish(data="again of a")
        assert await ear.next() == (a.uri, publisher.type.serialize({"data": "again of a"}))


async def test_a_bridge_latches_one_message_of_each_source(make_node: MakeNode) -> None:
    async with make_node("bridge") as bridge, make_node("late") as late:
        publisher = await bridge.advertise("t", STRING)
        for source, text in (("x", "old"), ("y", "of y"), ("z", "of z"), ("x", "of x")):
            payload = publisher.type.serialize({"data": text})
            publisher.publish_serialized(payload, latch=True, source=source)
        publisher.publish(data="not latched")
        publisher.unlatch("y")
        subscriber = await late.subscribe("t", STRING)
        assert sorted(await collect(subscriber, 2)) == ["of x", "of z"]
        publisher.publish(data="last")
        assert await collect(subscriber, 1) == ["last"]
