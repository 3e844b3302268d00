"""Links: topics and services of two masters over one connection, which breaks, hangs or is made again."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import partial
from urllib.parse import urlsplit

import pytest
from support.multimaster import STRING, node
from support.ports import free_ports
from support.relays import (
    check_that_all_that_is_latched_is_heard,
    heard_at_once,
    linked,
    published_until_heard,
    sync_of,
)
from support.slow_link import SlowLink

from rce.ros.core import Core, Graph
from rce.ros.errors import ServiceError, ServiceFaultError
from rce.ros.multimaster.sync import MasterSync, SyncSettings
from rce.ros.node import Subscriber
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient


def _has_subscribers(topic: str, graph: Graph) -> bool:
    return bool(graph.subscribers(topic))


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


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
async def test_sides_that_dial_each_other_keep_one_link(names: tuple[str, str]) -> None:
    """Over two links each message came twice."""
    ports = free_ports(2)
    async with AsyncExitStack() as stack:
        cores = [await stack.enter_async_context(Core(port=0)) for _ in range(2)]
        for core, name, port, other in zip(cores, names, ports, reversed(ports), strict=True):
            dialed = (("127.0.0.1", other),)
            await stack.enter_async_context(
                sync_of(core, relay_name=name, relay_listen=port, relay_addr="127.0.0.1", relay_to=dialed)
            )
        talker = await stack.enter_async_context(node("talker", cores[0].uri))
        listener = await stack.enter_async_context(node("listener", cores[1].uri))
        said = await talker.advertise("said", STRING)
        heard = await listener.subscribe("said", STRING)
        await published_until_heard(said, heard)
        clean = 0
        for turn in range(100):
            texts = [f"{turn} {number}" for number in range(5)]
            for text in (*texts, f"end {turn}"):
                said.publish(data=text)
            found = [message async for message in until_text(heard, f"end {turn}")]
            clean = clean + 1 if [text for text in found if text in texts] == texts else 0
            if clean == 30:  # more than one attempt to dial
                return
            await asyncio.sleep(0.2)
        raise AssertionError("messages come twice, or are lost")


async def until_text(subscriber: Subscriber, last: str) -> AsyncIterator[str]:
    """Yield the texts that come, the last one excluded, and what follows it at once."""
    async with asyncio.timeout(20):
        while (text := (await anext(aiter(subscriber))).data) != last:
            yield text


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
                said.publish(data="not listened to")
                await asyncio.sleep(0.02)


async def test_link_keeps_what_each_publisher_latched() -> None:
    async with linked() as (cloud, robot, _, _):
        await check_that_all_that_is_latched_is_heard(robot, cloud.uri, ("/tf_static", "/tf_static"))


async def test_link_forgets_what_has_no_listener() -> None:
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
