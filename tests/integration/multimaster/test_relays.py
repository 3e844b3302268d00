"""Relays: to another name, into a namespace, and over one connection."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import pytest
from support.multimaster import STRING, DiscoveryNetwork, node
from support.slow_link import SlowLink

from rce.ros.core import Core, Graph
from rce.ros.errors import ServiceError, ServiceFaultError
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.relay.frames import PROTOCOL
from rce.ros.multimaster.relay.link import UNAUTHENTICATED_PER_ADDRESS
from rce.ros.multimaster.relay.throttle import MessageThrottle
from rce.ros.multimaster.relay.topic import TopicRelay
from rce.ros.multimaster.sync import MasterSync, SyncSettings
from rce.ros.node import Message, Publisher, Subscriber
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient


@pytest.fixture
async def core() -> AsyncIterator[Core]:
    async with Core(port=0) as core:
        yield core


@asynccontextmanager
async def relaying(core: Core, relay: TopicRelay) -> AsyncIterator[None]:
    async with node("relay", core.uri) as relayer:
        task = asyncio.create_task(relay.run(relayer))
        try:
            yield
        finally:
            task.cancel()
            await asyncio.wait([task])


async def published_until_heard(publisher: Publisher, heard: Subscriber, **fields: object) -> Message:
    """Publish a message again and again until a subscriber of the relay's target has one.

    A connection alone does not show that the relay takes messages: it opens one to learn the type.
    """
    arrived = asyncio.ensure_future(anext(aiter(heard)))
    async with asyncio.timeout(60):
        while not arrived.done():
            publisher.publish(**fields)
            await asyncio.sleep(0.02)
    return await arrived


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


async def heard_at_once(uri: str, topic: str, count: int) -> set[str]:
    """Subscribe, and wait for so many messages, without any being published."""
    async with node(f"late_{count}", uri) as late:
        heard = aiter(await late.subscribe(topic, STRING))
        async with asyncio.timeout(60):
            return {(await anext(heard)).data for _ in range(count)}


async def latching(core: Core, name: str, topic: str, nodes: AsyncExitStack) -> Publisher:
    """A node that has latched its name."""
    started = await nodes.enter_async_context(node(name, core.uri))
    publisher = await started.advertise(topic, STRING, latch=True)
    publisher.publish(data=name)
    return publisher


async def check_that_all_that_is_latched_is_heard(source: Core, target: str, topics: tuple[str, str]) -> None:
    """Each of two publishers, by each of two subscribers; then no longer the one that ended."""
    here, there = topics
    async with AsyncExitStack() as nodes, AsyncExitStack() as brief:
        one = await latching(source, "one", here, nodes)
        await latching(source, "two", here, brief)
        async with node("listener", target) as listener:
            heard = aiter(await listener.subscribe(there, STRING))
            async with asyncio.timeout(60):
                assert {(await anext(heard)).data, (await anext(heard)).data} == {"one", "two"}
            assert await heard_at_once(target, there, 2) == {"one", "two"}
            await brief.aclose()
            async with asyncio.timeout(60):
                while "two" in await heard_before_a_mark(one, target, there):
                    pass


async def heard_before_a_mark(marking: Publisher, uri: str, topic: str) -> set[str]:
    """Return what a new subscriber is given before something that is published then."""
    found: set[str] = set()
    async with node("asking", uri) as asking:
        subscriber = await asking.subscribe(topic, STRING)
        await subscriber.wait_for_publishers(timeout=60)
        mark = f"mark {id(subscriber)}"
        marking.publish(data=mark)
        while mark not in found:
            found.add((await anext(aiter(subscriber))).data)
    return found


async def test_relay_keeps_what_each_publisher_latched(core: Core) -> None:
    async with relaying(core, TopicRelay("from", "to")):
        await check_that_all_that_is_latched_is_heard(core, core.uri, ("/from", "/to"))


async def test_lazy_relay_forgets_what_nobody_listens_to(core: Core) -> None:
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
                publisher.publish(data="nobody listens")
                await asyncio.sleep(0.02)


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


def _has_subscribers(topic: str, graph: Graph) -> bool:
    return bool(graph.subscribers(topic))


async def heard_within(subscriber: Subscriber, publisher: Publisher) -> bool:
    """Publish once; tell whether it arrived soon. A relay takes a moment until it is wanted."""
    publisher.publish(data="go")
    try:
        async with asyncio.timeout(0.3):
            return bool((await anext(aiter(subscriber))).data == "go")
    except TimeoutError:
        return False


@asynccontextmanager
async def linked(
    token: str = "", **lists: list[str]
) -> AsyncIterator[tuple[Core, Core, MasterSync, MasterSync]]:
    """Two cores that know each other by one connection only: no discovery, no direct way."""
    chosen = SyncLists.read(lists)
    async with Core(port=0) as cloud, Core(port=0) as robot:
        listening = SyncSettings(
            cloud.uri, relay_listen=0, relay_addr="127.0.0.1", relay_token="t", relay_name="cloud"
        )
        async with MasterSync(listening) as one:
            dialing = SyncSettings(
                robot.uri,
                lists=chosen,
                relay_to=(("127.0.0.1", one.relay_port),),
                relay_token=token or "t",
                relay_name="robot",
            )
            async with MasterSync(dialing) as other:
                yield cloud, robot, one, other


async def test_one_connection_carries_topics_and_services_both_ways() -> None:
    async with (
        linked(ignore_topics=["/secret"]) as (cloud, robot, _, _),
        node("planner", cloud.uri) as planner,
        node("base", robot.uri) as base,
    ):
        said, answered = await base.advertise("said", STRING), await planner.advertise("answered", STRING)
        await base.advertise("secret", STRING)
        heard, got = await planner.subscribe("said", STRING), await base.subscribe("answered", STRING)
        for publisher, subscriber, core in ((said, heard, robot), (answered, got, cloud)):
            topic = publisher.topic
            await core.wait_until(partial(_has_subscribers, topic), timeout=20)
            await publisher.wait_for_subscribers(timeout=20)
            body = "x" * 3_000_000
            publisher.publish(data=body)
            async with asyncio.timeout(60):
                assert (await anext(aiter(subscriber))).data == body
        assert base.uri not in cloud.graph.nodes.values()
        assert "/secret" not in cloud.graph.topic_types

        def refuse(_: object) -> None:
            raise ServiceFaultError("/add", "not today")

        await planner.advertise_service("add", "roscpp/GetLoggers", lambda _: {"loggers": []})
        await planner.advertise_service("refuse", "roscpp/Empty", refuse)
        await robot.wait_until(
            lambda graph: None not in (graph.service("/refuse"), graph.service("/add")), timeout=20
        )
        assert (await base.service_client("add", "roscpp/GetLoggers").call({}, timeout=20)).loggers == []
        with pytest.raises(ServiceFaultError, match="not today"):
            await base.service_client("refuse", "roscpp/Empty").call({}, timeout=20)


@pytest.mark.parametrize("large", ["calls", "answers"])
async def test_calls_that_a_slow_link_cannot_hold_fail(large: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits for a connection is in memory; the caller learns that there is too much of it."""
    monkeypatch.setattr("rce.ros.multimaster.relay.connection.MAX_WAITING", 2**23)
    text = "x" * 2**22
    count = 8
    settings = SyncSettings(relay_listen=0, relay_addr="127.0.0.1", relay_token="t", relay_name="cloud")
    async with AsyncExitStack() as stack:
        cloud, robot = [await stack.enter_async_context(Core(port=0)) for _ in range(2)]
        one = await stack.enter_async_context(MasterSync(replace(settings, master_uri=cloud.uri)))
        slow = await stack.enter_async_context(SlowLink(f"ws://127.0.0.1:{one.relay_port}").running())
        host, _, port = slow.endpoint.partition(":")
        dialing = SyncSettings(robot.uri, relay_to=((host, int(port)),), relay_token="t", relay_name="robot")
        await stack.enter_async_context(MasterSync(dialing))
        provider = await stack.enter_async_context(node("provider", cloud.uri))
        caller = await stack.enter_async_context(node("caller", robot.uri))
        came = 0
        all_came = asyncio.Event()

        async def answer(_: object) -> dict[str, object]:
            nonlocal came
            came += 1
            if came == count:
                slow.hangs = True
                all_came.set()
            await all_came.wait()
            return {"loggers": [{"name": text, "level": ""}]}

        await provider.advertise_service("small", "roscpp/SetLoggerLevel", lambda _: {})
        await provider.advertise_service("large", "roscpp/GetLoggers", answer)
        await robot.wait_until(
            lambda graph: None not in (graph.service("/small"), graph.service("/large")), timeout=20
        )
        if large == "calls":
            slow.hangs = True
            client = caller.service_client("small", "roscpp/SetLoggerLevel")
            calls = [client.call({"logger": text}, timeout=30) for _ in range(count)]
        else:
            client = caller.service_client("large", "roscpp/GetLoggers")
            calls = [client.call({}, timeout=30) for _ in range(count)]
        working = [asyncio.ensure_future(call) for call in calls]
        if large == "calls":
            await asyncio.wait(working, return_when=asyncio.FIRST_COMPLETED, timeout=20)
        else:
            await asyncio.wait_for(all_came.wait(), 20)
        slow.hangs = False
        results = await asyncio.gather(*working, return_exceptions=True)
        failures = [result for result in results if isinstance(result, ServiceFaultError)]
        assert 1 <= len(failures) < count, results
        assert all("connection is too slow" in failure.text for failure in failures)
        assert not [result for result in results if isinstance(result, Exception) and result not in failures]


async def test_a_link_brings_messages_only_while_there_is_a_subscriber() -> None:
    async with (
        linked() as (cloud, robot, _, _),
        node("planner", cloud.uri) as planner,
        node("base", robot.uri) as base,
    ):
        said = await base.advertise("said", STRING)
        await cloud.wait_until(lambda graph: "/said" in graph.topic_types, timeout=20)
        assert robot.graph.subscribers("/said") == {}
        heard = await planner.subscribe("said", STRING)
        await robot.wait_until(lambda graph: bool(graph.subscribers("/said")), timeout=20)
        await said.wait_for_subscribers(timeout=20)
        await heard.close()
        async with asyncio.timeout(60):
            while said.connections:
                said.publish(data="nobody listens")
                await asyncio.sleep(0.02)


async def test_link_keeps_what_each_publisher_latched() -> None:
    async with linked() as (cloud, robot, _, _):
        await check_that_all_that_is_latched_is_heard(robot, cloud.uri, ("/tf_static", "/tf_static"))


async def test_link_forgets_what_nobody_listens_to() -> None:
    """A later subscriber gets what is latched then, and not what was at the last subscription."""
    async with linked() as (cloud, robot, one, _), node("base", robot.uri) as base:
        publisher = await base.advertise("said", STRING, latch=True)
        publisher.publish(data="old")
        assert await heard_at_once(cloud.uri, "/said", 1) == {"old"}
        async with asyncio.timeout(60):
            while publisher.connections:
                publisher.publish(data="new")
                await asyncio.sleep(0.02)
            publisher.publish(data="newest")
            (relayed,) = one._node._topics.outputs["/said"].publishers
            while relayed.latched:
                await asyncio.sleep(0.02)
        assert await heard_at_once(cloud.uri, "/said", 1) == {"newest"}


async def test_topic_of_both_sides_is_not_sent_back() -> None:
    async with (
        linked() as (cloud, robot, _, _),
        node("planner", cloud.uri) as planner,
        node("base", robot.uri) as base,
    ):
        first, second = await base.advertise("said", STRING), await planner.advertise("said", STRING)
        at_robot, at_cloud = await base.subscribe("said", STRING), await planner.subscribe("said", STRING)
        for subscriber in (at_robot, at_cloud):
            await subscriber.wait_for_publishers(2, timeout=30)  # the one of that side, and the relay
        for publisher in (first, second):
            await publisher.wait_for_subscribers(2, timeout=30)
        for word in ("one", "two", "three"):
            first.publish(data=word)
            async with asyncio.timeout(60):
                assert (await anext(aiter(at_robot))).data == word
                assert (await anext(aiter(at_cloud))).data == word


async def test_silent_host_delays_no_relay_of_others() -> None:
    """Its topics and services cannot be learned: each takes seconds until that is known."""
    with socket.create_server(("127.0.0.1", 0)) as silent:  # takes connections and says nothing
        port = silent.getsockname()[1]
        async with (
            linked() as (cloud, robot, _, _),
            node("planner", cloud.uri) as planner,
            node("base", robot.uri) as base,
            RpcClient() as rpc,
        ):
            api, address = f"http://127.0.0.1:{port}/", f"rosrpc://127.0.0.1:{port}"
            for number in range(6):
                await rpc.call(robot.uri, "registerPublisher", ("/away", f"/away{number}", STRING, api))
                await rpc.call(robot.uri, "registerService", ("/away", f"/ask{number}", address, api))
            said, heard = await base.advertise("said", STRING), await planner.subscribe("said", STRING)
            async with asyncio.timeout(20):
                assert (await published_until_heard(said, heard, data="here")).data == "here"


async def test_side_that_dials_again_stays_linked() -> None:
    """Its former link may be noticed to be dead only after the new one was made."""
    async with linked() as (_, robot, one, other), AsyncExitStack() as stack:
        again = SyncSettings(
            robot.uri,
            node_name="again",
            relay_to=(("127.0.0.1", one.relay_port),),
            relay_token="t",
            relay_name="robot",
        )
        await stack.enter_async_context(MasterSync(again))
        async with asyncio.timeout(60):
            while len(one._links._running) < 2:
                await asyncio.sleep(0.02)
            await other.__aexit__(None, None, None)
            while len(one._links._running) > 1:
                await asyncio.sleep(0.02)
        assert one._links.connected == {"robot"}


async def test_a_broken_link_takes_back_and_comes_back() -> None:
    async with (
        linked() as (cloud, robot, one, _),
        node("base", robot.uri) as base,
    ):
        await base.advertise("said", STRING)
        await cloud.wait_until(lambda graph: "/said" in graph.topic_types, timeout=20)
        with cloud.watch() as events:
            (link,) = one._links._running
            assert link._transport is not None
            link._transport.abort()
            gone = back = False
            async with asyncio.timeout(60):
                async for event in events:
                    gone = gone or (event.name, event.change.value) == ("/said", "publisher removed")
                    back = gone and (event.name, event.change.value) == ("/said", "publisher added")
                    if back:
                        break


async def test_replaced_publisher_and_provider_bring_their_type() -> None:
    """A rebuilt node takes the place of the former one between two looks at the graph."""
    async with (
        linked() as (cloud, robot, _, _),
        node("base", robot.uri) as base,
        node("rebuilt", robot.uri) as rebuilt,
        node("planner", cloud.uri) as planner,
        asyncio.timeout(60),
    ):
        said = await base.advertise("said", STRING)
        did = await base.advertise_service("do", "std_srvs/Empty", lambda _: None)
        await cloud.wait_until(partial(_has_all, {"/said"}, "/do"))
        number = await rebuilt.advertise("said", "std_msgs/Int32")
        await rebuilt.advertise_service("do", "std_srvs/SetBool", lambda _: {"success": True})
        await said.close()
        await did.close()
        assert robot.graph.publishers("/said") == {"/rebuilt": rebuilt.uri}
        assert robot.graph.service("/do") == rebuilt.service_uri
        heard = await planner.subscribe("said", "std_msgs/Int32")
        assert (await published_until_heard(number, heard, data=7)).data == 7
        while True:
            try:
                answer = await planner.service_client("do", "std_srvs/SetBool").call(
                    {"data": True}, timeout=9
                )
            except ServiceError:
                await asyncio.sleep(0.05)
            else:
                break
        assert answer.success


async def test_own_stale_registration_does_not_stop_a_service() -> None:
    """A registration whose caller gave up may have reached the master all the same."""
    async with linked() as (cloud, robot, one, _), node("base", robot.uri) as base:
        relay = one._node
        master = MasterClient(cloud.uri, relay.name, relay.uri, relay._running.rpc)
        await master.register_service("/clear", relay.service_uri)
        await base.advertise_service("clear", "roscpp/Empty", lambda _: None)
        async with node("planner", cloud.uri) as planner, asyncio.timeout(30):
            client = planner.service_client("clear", "roscpp/Empty")
            while True:
                try:
                    await client.call({}, timeout=20)
                except ServiceError:
                    await asyncio.sleep(0.05)
                else:
                    break


@pytest.mark.parametrize("what", ["the offer shrinks", "the link breaks"])
async def test_link_outlives_a_master_that_is_away(what: str, caplog: pytest.LogCaptureFixture) -> None:
    """It cannot tell that master what went away meanwhile; when it is back, everything is relayed."""
    caplog.set_level("INFO", "rce.ros.closing")
    async with AsyncExitStack() as cores, Core(port=0) as robot, node("base", robot.uri) as base:
        cloud = await cores.enter_async_context(Core(port=0))
        port = urlsplit(cloud.uri).port or 0
        async with (
            sync_of(cloud, relay_listen=0, relay_addr="127.0.0.1", relay_name="cloud") as one,
            sync_of(robot, relay_to=(("127.0.0.1", one.relay_port),), relay_name="robot"),
        ):
            said = [await base.advertise(name, STRING) for name in ("said", "also")]
            service = await base.advertise_service("clear", "roscpp/Empty", lambda _: None)
            await cloud.wait_until(partial(_has_all, {"/said", "/also"}, "/clear"), timeout=30)
            await cores.aclose()
            if what == "the offer shrinks":
                await said[0].close()
                await service.close()
            else:
                (link,) = one._links._running
                assert link._transport is not None
                link._transport.abort()
            async with asyncio.timeout(60):
                while "closed without telling the master" not in caplog.text:
                    await asyncio.sleep(0.02)
            async with Core(port=port) as again:
                if what == "the offer shrinks":
                    await base.advertise("said", STRING)
                    await base.advertise_service("clear", "roscpp/Empty", lambda _: None)
                await again.wait_until(partial(_has_all, {"/said", "/also"}, "/clear"), timeout=60)
                async with node("planner", again.uri) as planner:
                    heard = await planner.subscribe("also", STRING)
                    assert (await published_until_heard(said[1], heard, data="back")).data == "back"
                    await planner.service_client("clear", "roscpp/Empty").call({}, timeout=20)


def _has_all(topics: set[str], service: str, graph: Graph) -> bool:
    return topics <= graph.topic_types.keys() and graph.service(service) is not None


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


async def test_another_token_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    async with linked(token="wrong") as (cloud, robot, one, other), node("base", robot.uri) as base:
        await base.advertise("said", STRING)
        async with asyncio.timeout(60):
            while "another token" not in caplog.text:
                await asyncio.sleep(0.02)
        assert one._links.connected == other._links.connected == set()
        assert "/said" not in cloud.graph.topic_types


@asynccontextmanager
async def sync_of(core: Core, **settings: Any) -> AsyncIterator[MasterSync]:
    async with MasterSync(SyncSettings(core.uri, relay_token="t", **settings)) as sync:
        yield sync


async def until_linked(sync: MasterSync, *names: str) -> None:
    async with asyncio.timeout(60):
        while sync._links.connected != set(names):
            await asyncio.sleep(0.02)


async def test_links_are_taken_after_a_proof_that_is_no_text() -> None:
    """Half a surrogate pair, which JSON can carry and UTF-8 cannot."""
    async with (
        Core(port=0) as cloud,
        Core(port=0) as robot,
        sync_of(cloud, relay_listen=0, relay_addr="127.0.0.1", relay_name="cloud") as one,
    ):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        hello = {"protocol": PROTOCOL, "name": "stranger", "nonce": "ab" * 32, "proof": ""}
        writer.write(greeting("H", hello) + greeting("R", {"proof": "\ud800"}))
        await read_all(reader)
        writer.close()
        async with sync_of(robot, relay_to=(("127.0.0.1", one.relay_port),), relay_name="robot") as other:
            await until_linked(one, "robot")
            await until_linked(other, "cloud")


async def test_dialing_goes_on_after_a_false_server() -> None:
    came: asyncio.Queue[None] = asyncio.Queue()

    async def lie(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        came.put_nowait(None)
        hello = {"protocol": PROTOCOL, "name": "cloud", "nonce": "", "proof": "\ud800"}
        writer.write(greeting("N", {"nonce": "ab" * 32}) + greeting("H", hello))
        await read_all(reader)
        writer.close()

    server = await asyncio.start_server(lie, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, Core(port=0) as robot, sync_of(robot, relay_to=(("127.0.0.1", port),)):
        async with asyncio.timeout(60):
            await came.get()
            await came.get()


async def read_all(reader: asyncio.StreamReader) -> bytes:
    """Read until the connection ends, however it does."""
    try:
        async with asyncio.timeout(60):
            return await reader.read()
    except ConnectionError:
        return b""


def greeting(kind: str, said: dict[str, Any]) -> bytes:
    body = json.dumps(said).encode()
    return struct.pack("<IB", 1 + len(body), ord(kind)) + body


@pytest.mark.parametrize("says", ["nothing", "hello", "hello and a wrong proof", "the old hello"])
async def test_stranger_learns_nothing_but_a_nonce(says: str, caplog: pytest.LogCaptureFixture) -> None:
    """Neither token, nor name, nor topics; before a hello not a byte. It is hung up on within seconds."""
    async with linked() as (_, _, one, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        if says == "the old hello":
            writer.write(greeting("H", {"protocol": 1, "name": "stranger", "token": ""}))
        elif says != "nothing":
            writer.write(
                greeting("H", {"protocol": PROTOCOL, "name": "stranger", "nonce": "ab" * 32, "proof": ""})
            )
        if "proof" in says:
            writer.write(greeting("R", {"proof": "00" * 32}))
        answer = await read_all(reader)
        writer.close()
        if says in ("nothing", "the old hello"):
            assert answer == b""
        else:
            length, kind = struct.unpack_from("<IB", answer)
            assert (kind, len(answer)) == (ord("N"), 4 + length), "a challenge and nothing else"
            assert list(json.loads(answer[5:])) == ["nonce"]
        assert "stranger" not in one._links.connected
    assert caplog.text.count("relay link from 127.0.0.1") == 1


async def test_stranger_cannot_send_much(caplog: pytest.LogCaptureFixture) -> None:
    """A large frame is refused by its header."""
    async with linked() as (_, _, one, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        writer.write(struct.pack("<IB", 60_000_000, ord("D")))
        assert await read_all(reader) == b""
        writer.close()
    assert "a frame of 60000000 bytes" in caplog.text


async def test_stranger_cannot_say_much(caplog: pytest.LogCaptureFixture) -> None:
    """Many small frames end the connection; none of them is kept."""
    async with linked() as (_, _, one, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", one.relay_port)
        writer.write(greeting("N", {"nonce": ""}) * 50)
        assert await read_all(reader) == b""
        writer.close()
    assert caplog.text.count("relay link from 127.0.0.1") == 1


async def test_strangers_are_bounded_in_number() -> None:
    async with linked() as (_, _, one, other):
        async with asyncio.timeout(60):
            while "cloud" not in other._links.connected:
                await asyncio.sleep(0.02)
        connections = [await asyncio.open_connection("127.0.0.1", one.relay_port) for _ in range(60)]
        async with asyncio.timeout(60):
            while one._links._lobby.turned_away < 60 - UNAUTHENTICATED_PER_ADDRESS:
                await asyncio.sleep(0.02)
        assert len(one._links._lobby) <= UNAUTHENTICATED_PER_ADDRESS
        assert one._links.connected == {"robot"}, "who is known continues"
        for _, writer in connections:
            writer.close()


@pytest.mark.parametrize("where", [[], ["--relay-addr", "0.0.0.0"]])
async def test_program_does_not_listen_for_everybody(where: list[str]) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", "from rce.cli.main import main; main()"),
        *("sync", "--relay-listen", "0", *where),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    output, _ = await process.communicate()
    assert process.returncode == 1
    assert b"need a token: give --relay-token" in output
    assert b"Traceback" not in output
