"""Relays of one topic to another name, and of a master's names into a namespace."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from urllib.parse import urlsplit

import pytest
from support.multimaster import STRING, DiscoveryNetwork, node
from support.relays import check_that_all_that_is_latched_is_heard, heard_at_once, published_until_heard

from rce.ros.core import Core
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.relay.throttle import MessageThrottle
from rce.ros.multimaster.relay.topic import TopicRelay
from rce.ros.node import Node, Publisher, Subscriber
from rce.ros.types import Time


@pytest.fixture
async def core() -> AsyncIterator[Core]:
    async with Core(port=0) as core:
        yield core


@asynccontextmanager
async def relaying(core: Core, relay: TopicRelay) -> AsyncIterator[Node]:
    async with node("relay", core.uri) as relayer:
        task = asyncio.create_task(relay.run(relayer))
        try:
            yield relayer
        finally:
            task.cancel()
            await asyncio.wait([task])


async def test_a_topic_of_a_type_that_nobody_here_knows_is_relayed(core: Core) -> None:
    from rce.ros.types import TypeRegistry

    kind = TypeRegistry().from_definition("strange_msgs/Thing", "int32 number\nstring text\n")
    async with (
        relaying(core, TopicRelay("from", "to")),
        node("talker", core.uri) as talker,
        node("listener", core.uri) as listener,
    ):
        publisher = await talker.advertise("from", kind)
        heard = await listener.subscribe("to", kind)
        message = await published_until_heard(publisher, heard, number=7, text="seven")
        assert (message.number, message.text) == (7, "seven")
        assert core.graph.topic_types["/to"] == "strange_msgs/Thing"


async def test_what_is_latched_stays_latched(core: Core) -> None:
    async with node("talker", core.uri) as talker, relaying(core, TopicRelay("from", "to")):
        (await talker.advertise("from", STRING, latch=True)).publish(data="kept")
        async with node("late", core.uri) as late:
            heard = await late.subscribe("to", STRING)
            async with asyncio.timeout(60):
                assert (await anext(aiter(heard))).data == "kept"
            async with node("later", core.uri) as later:
                heard = await later.subscribe("to", STRING)
                async with asyncio.timeout(60):
                    assert (await anext(aiter(heard))).data == "kept"


async def test_relay_keeps_what_each_publisher_latched(core: Core) -> None:
    async with relaying(core, TopicRelay("from", "to")):
        await check_that_all_that_is_latched_is_heard(core, core.uri, ("/from", "/to"))


async def test_lazy_relay_forgets_what_has_no_listener(core: Core) -> None:
    async with relaying(core, TopicRelay("from", "to", lazy=True)), node("talker", core.uri) as talker:
        publisher = await talker.advertise("from", STRING, latch=True)
        publisher.publish(data="old")
        assert await heard_at_once(core.uri, "/to", 1) == {"old"}
        async with asyncio.timeout(60):
            while publisher.connections:
                publisher.publish(data="new")
                await asyncio.sleep(0.02)
        assert await heard_at_once(core.uri, "/to", 1) == {"new"}


async def test_a_lazy_relay_listens_only_while_it_has_a_subscriber(core: Core) -> None:
    async with (
        node("talker", core.uri) as talker,
        node("listener", core.uri) as listener,
        relaying(core, TopicRelay("from", "to", lazy=True)),
    ):
        publisher = await talker.advertise("from", STRING)
        await core.wait_until(lambda graph: "/to" in graph.topic_types, timeout=20)
        assert core.graph.subscribers("/from") == {}
        for word in ("one", "two"):
            heard = await listener.subscribe("to", STRING)
            assert (await published_until_heard(publisher, heard, data=word)).data == word
            await heard.close()
            while publisher.connections:
                publisher.publish(data="not listened to")
                await asyncio.sleep(0.02)


async def test_lazy_relay_that_waits_ends_with_its_node(core: Core) -> None:
    relay = TopicRelay("from", "to", lazy=True)
    async with asyncio.timeout(30), node("talker", core.uri) as talker, node("relay", core.uri) as relayer:
        await talker.advertise("from", STRING)
        task = asyncio.create_task(relay.run(relayer))
        await core.wait_until(lambda graph: bool(graph.publishers("/to")))
        relayer.shutdown("the test says so")
        await task


async def test_a_throttled_relay_holds_back(core: Core) -> None:
    relay = TopicRelay("from", "to", throttle=MessageThrottle(0.01))
    async with (
        node("talker", core.uri) as talker,
        node("listener", core.uri) as listener,
        relaying(core, relay),
    ):
        publisher = await talker.advertise("from", STRING)
        heard = await listener.subscribe("to", STRING)
        assert (await published_until_heard(publisher, heard, data="first")).data == "first"
        for _ in range(4):
            publisher.publish(data="later")
        async with asyncio.timeout(60):
            while relay.held_back < 4:
                await asyncio.sleep(0.02)
        assert relay.passed == 1


@pytest.mark.parametrize("wall_clock", [False, True])
async def test_throttle_counts_in_simulated_time(core: Core, wall_clock: bool) -> None:
    """As topic_tools' throttle does, and with ``wall_clock`` not."""
    core.set_param("/use_sim_time", True)
    relay = TopicRelay("from", "to", throttle=MessageThrottle(0.001), wall_clock=wall_clock)
    async with (
        asyncio.timeout(60),
        node("talker", core.uri) as talker,
        node("listener", core.uri) as listener,
        relaying(core, relay) as relayer,
    ):
        clock = await talker.advertise("/clock", "rosgraph_msgs/Clock", latch=True)
        publisher = await talker.advertise("from", STRING)
        heard = await listener.subscribe("to", STRING)
        clock.publish(clock=Time(1))
        assert (await published_until_heard(publisher, heard, data="first")).data == "first"
        clock.publish(clock=Time(2000))
        while relayer.time() < 2000:
            await asyncio.sleep(0.01)
        held_back = relay.held_back
        publisher.publish(data="second")
        while relay.passed + relay.held_back == 1 + held_back:
            await asyncio.sleep(0.01)
        assert relay.passed == (1 if wall_clock else 2)


async def test_a_namespace_for_a_master(network: DiscoveryNetwork) -> None:
    lists = SyncLists.read({"ignore_topics": ["/secret"]})
    async with (
        network.machine(name="robot") as robot,
        network.machine(namespaces={"robot": "Robot1"}, lists=lists) as station,
        node("amcl", robot.uri) as amcl,
        node("planner", station.uri) as planner,
    ):
        pose = await amcl.advertise("amcl_pose", STRING)
        await amcl.advertise("secret", STRING)
        goals = await amcl.subscribe("goals", STRING)
        await amcl.advertise_service("clear", "roscpp/GetLoggers", lambda _: {"loggers": [{"name": "x"}]})
        poses = await planner.subscribe("/Robot1/amcl_pose", STRING)
        goal = await planner.advertise("/Robot1/goals", STRING)

        await station.until(lambda graph: graph.service("/Robot1/clear") is not None)
        await robot.until(lambda graph: bool(graph.subscribers("/amcl_pose")))
        await pose.wait_for_subscribers(timeout=20)
        pose.publish(data="here")
        async with asyncio.timeout(60):
            assert (await anext(aiter(poses))).data == "here"
        await goal.wait_for_subscribers(timeout=20)
        await robot.until(lambda graph: bool(graph.publishers("/goals")))
        async with asyncio.timeout(60):
            await goals.wait_for_publishers()
            while not (await heard_within(goals, goal)):
                pass
        answer = await planner.service_client("/Robot1/clear", "roscpp/GetLoggers").call({}, timeout=20)
        assert [logger.name for logger in answer.loggers] == ["x"]
        assert {"/Robot1/secret", "/amcl_pose", "/secret"} & station.graph.topic_types.keys() == set()


async def heard_within(subscriber: Subscriber, publisher: Publisher) -> bool:
    """Publish once; tell whether it arrived soon. A relay takes a moment until it is wanted."""
    publisher.publish(data="go")
    try:
        async with asyncio.timeout(0.3):
            return bool((await anext(aiter(subscriber))).data == "go")
    except TimeoutError:
        return False


async def test_namespace_outlives_its_master(
    network: DiscoveryNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "rce.ros.closing")
    async with AsyncExitStack() as cores, network.machine(namespaces={"robot": "Robot1"}) as station:
        core = await cores.enter_async_context(Core(port=0))
        async with (
            Discovery(network.settings(core.uri, name="robot")),
            node("planner", station.uri) as planner,
            node("base", core.uri) as base,
        ):
            await base.advertise("said", STRING)
            goal = await planner.advertise("/Robot1/goal", STRING)
            await station.until(lambda graph: "/Robot1/said" in graph.topic_types)
            await core.wait_until(lambda graph: "/goal" in graph.topic_types, timeout=20)
            await cores.aclose()
            await goal.close()
            async with asyncio.timeout(60):
                while "closed without telling the master" not in caplog.text:
                    await asyncio.sleep(0.02)
            async with Core(port=urlsplit(core.uri).port or 0) as again:
                await planner.advertise("/Robot1/other", STRING)
                await again.wait_until(lambda graph: "/other" in graph.topic_types, timeout=60)
