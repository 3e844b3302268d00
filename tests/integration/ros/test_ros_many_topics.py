"""Nodes with hundreds of topics, as the environment and the planner of a large fleet: work for each topic."""

from __future__ import annotations

import asyncio

import pytest
from support.ros_nodes import MakeNode
from support.ros_requests import count_requests

from rce.ros.core import Core
from rce.ros.node import member
from rce.ros.xmlrpc import RpcServer, server
from rce.ros.xmlrpc.client import MAX_CONNECTIONS

STRING = "std_msgs/String"
MANY = 400


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The length of each XML-RPC request to a server of this process."""
    return count_requests(monkeypatch)


@pytest.mark.parametrize("first", ["publishers", "subscribers"])
async def test_topics_of_many_robots_share_requests(
    core: Core, make_node: MakeNode, requests: list[int], first: str
) -> None:
    """Each is registered twice, reported to its subscriber, and asked for the address of its publisher."""
    topics = [f"/Robot{number}/cancelGoal" for number in range(MANY)]
    async with make_node("a") as a, make_node("b") as b, asyncio.timeout(120):
        if first == "publishers":
            publishers = await asyncio.gather(*(a.advertise(topic, STRING) for topic in topics))
            subscribers = await asyncio.gather(*(b.subscribe(topic, STRING) for topic in topics))
        else:
            subscribers = await asyncio.gather(*(b.subscribe(topic, STRING) for topic in topics))
            publishers = await asyncio.gather(*(a.advertise(topic, STRING) for topic in topics))
        for publisher, subscriber in zip(publishers, subscribers, strict=True):
            await publisher.wait_for_subscribers()
            publisher.publish(data=publisher.topic)
            assert (await anext(aiter(subscriber))).data == subscriber.topic
        calls = (3 if first == "publishers" else 4) * MANY
        assert len(requests) < calls / 10


async def test_core_gets_few_connections_for_many_topics(
    core: Core, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each takes memory of the core and of its client: thousands of them do not fit into a container."""
    made: list[object] = []
    accept = server.RpcServer._accept

    def count(self: RpcServer) -> object:
        made.append(self)
        return accept(self)

    monkeypatch.setattr(server.RpcServer, "_accept", count)
    async with make_node("a") as a, asyncio.timeout(120):
        await asyncio.gather(*(a.advertise(f"/t{number}", STRING) for number in range(MANY)))
        assert len(core.graph.published()) >= MANY
    assert len(made) <= MAX_CONNECTIONS + 1  # one more to notice the end of the core


async def test_no_topic_is_missed_of_a_node_that_comes_back(
    core: Core, make_node: MakeNode, requests: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its topics are reported anew to a node that is subscribed to all of them."""
    monkeypatch.setattr(member, "GOODBYE_TIMEOUT", 60.0)  # on a busy machine it takes longer than usual
    topics = [f"/t{number}" for number in range(MANY)]
    async with make_node("b") as b, asyncio.timeout(120):
        subscribers = await asyncio.gather(*(b.subscribe(topic, STRING) for topic in topics))
        for _ in range(2):
            async with make_node("a") as a:
                await asyncio.gather(*(a.advertise(topic, STRING) for topic in topics))
                for subscriber in subscribers:
                    await subscriber.wait_for_publishers()
            assert not any(core.graph.publishers(topic) for topic in topics)
            await core.wait_until(lambda _: not any(subscriber.connections for subscriber in subscribers))
    assert len(requests) < 10 * MANY / 10


async def test_node_registers_many_topics_again_in_few_requests(
    core: Core, make_node: MakeNode, requests: list[int]
) -> None:
    """As when its master was restarted."""
    topics = [f"/t{number}" for number in range(MANY)]
    async with make_node("a") as a, asyncio.timeout(120):
        await asyncio.gather(*(a.advertise(topic, STRING) for topic in topics))
        await asyncio.gather(*(a.subscribe(topic, STRING) for topic in topics))
        assert core.forget_node("/a")
        requests.clear()
        await a.reregister()
        assert all(core.graph.publishers(topic) == {"/a": a.uri} for topic in topics)
        assert all(core.graph.subscribers(topic) == {"/a": a.uri} for topic in topics)
        assert len(requests) < 2 * 2 * MANY / 10
