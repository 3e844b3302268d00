"""Synchronization between our cores, each with discovery and sync of its own."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack
from typing import Any

import pytest
from support.multimaster import STRING, DiscoveryNetwork, node
from support.ports import free_port
from support.ros_busy_node import answering_second_call

from rce.aio.tasks import TaskScope
from rce.ros.core import Core
from rce.ros.errors import MasterUnreachableError
from rce.ros.multimaster import registrar
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.plan import Registration, RegistrationKind
from rce.ros.multimaster.registrar import Registrar
from rce.ros.multimaster.remote import Remote
from rce.ros.multimaster.source import multicall_as
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient


async def test_a_topic_reaches_the_other_master(network: DiscoveryNetwork) -> None:
    async with network.machine() as a, network.machine() as b:
        async with node("talker", a.uri) as talker, node("listener", b.uri) as listener:
            heard = await listener.subscribe("chatter", STRING)
            publisher = await talker.advertise("chatter", STRING)
            await heard.wait_for_publishers(timeout=20)
            publisher.publish(data="hello")
            assert (await anext(aiter(heard))).data == "hello"
            await b.until(lambda graph: graph.publishers("/chatter") == {"/talker": talker.uri})
            await a.until(lambda graph: graph.subscribers("/chatter") == {"/listener": listener.uri})
        await b.until(lambda graph: "/chatter" not in graph.topic_types)
        await a.until(lambda graph: "/chatter" not in graph.topic_types)


async def test_a_service_can_be_called_from_the_other_master(network: DiscoveryNetwork) -> None:
    async with network.machine() as a, network.machine() as b:
        async with node("server", a.uri) as server, node("caller", b.uri) as caller:
            await server.advertise_service("add", "roscpp/GetLoggers", lambda _: {"loggers": [{"name": "x"}]})
            await b.until(lambda graph: graph.service("/add") is not None)
            answer = await caller.service_client("add", "roscpp/GetLoggers")()
            assert [logger.name for logger in answer.loggers] == ["x"]
        await b.until(lambda graph: graph.service("/add") is None)


async def test_only_what_was_chosen_is_synchronized(network: DiscoveryNetwork) -> None:
    lists = SyncLists.read({"sync_topics": ["/robot/*"], "ignore_topics": ["/robot/secret"]})
    async with (
        network.machine() as a,
        network.machine(lists=lists) as b,
        node("talker", a.uri) as talker,
    ):
        for topic in ("/robot/secret", "/other", "/rosout_agg", "/robot/pose"):
            await talker.advertise(topic, STRING)
        await b.until(lambda graph: "/robot/pose" in graph.topic_types)
        topics = {name for name in b.graph.topic_types if not name.startswith("/master_")}
        assert topics == {"/robot/pose", "/rosout"}


async def test_three_masters_do_not_pass_things_on_in_a_circle(network: DiscoveryNetwork) -> None:
    async with (
        network.machine() as a,
        network.machine() as b,
        network.machine() as c,
        node("talker", a.uri) as talker,
    ):
        await talker.advertise("chatter", STRING)
        for machine in (b, c):
            await machine.until(lambda graph: graph.publishers("/chatter") == {"/talker": talker.uri})
        assert a.sync.registrar.held == {}
        assert list(b.sync.registrar.held) == list(c.sync.registrar.held) == [a.uri]
        assert a.discovery.info is not None
        stamp = a.discovery.info.stamp_local
        await asyncio.sleep(1)  # nothing may happen
        assert a.discovery.info.stamp_local == stamp
        await talker.advertise("more", STRING)
        await c.until(lambda graph: "/more" in graph.topic_types)
        assert b.discovery.info is not None
        assert b.discovery.info.nodes["/talker"].master_uri == a.uri


async def test_what_a_vanished_master_had_is_taken_back(network: DiscoveryNetwork) -> None:
    """Not while it is offline, as it may be back: subscribers of roscpp would close their connections."""
    async with (
        network.machine(remove_after=3.0) as b,
        network.machine(name="a") as a,
        node("talker", a.uri) as talker,
    ):
        await talker.advertise("chatter", STRING)
        await b.until(lambda graph: "/chatter" in graph.topic_types)
        a.discovery._socket.send_to = lambda *_: None  # type: ignore[method-assign]  # no good-bye either
        await b.until_known("a", online=False)
        assert b.graph.publishers("/chatter") == {"/talker": talker.uri}
        await b.until(lambda graph: "/chatter" not in graph.topic_types)


@pytest.mark.parametrize("reachable", [True, False])
async def test_registrations_are_made_anew_after_an_outage(
    network: DiscoveryNetwork, monkeypatch: pytest.MonkeyPatch, reachable: bool
) -> None:
    """Connections may hang then. If only heartbeats were lost, they work: roscpp must not close them."""
    async with (
        network.machine() as b,
        network.machine(name="a") as a,
        node("talker", a.uri) as talker,
    ):
        await talker.advertise("chatter", STRING)
        await b.until(lambda graph: "/chatter" in graph.topic_types)
        assert b.core is not None
        with b.core.watch() as events:
            asked = asyncio.Event()

            async def is_reachable(_: Remote) -> bool:
                asked.set()
                return reachable

            monkeypatch.setattr(Remote, "_is_reachable", is_reachable)
            send = a.discovery._socket.send_to
            a.discovery._socket.send_to = lambda *_: None  # type: ignore[method-assign]  # the network is gone
            await asyncio.wait_for(asked.wait(), 20)
            a.discovery._socket.send_to = send  # type: ignore[method-assign]  # and back
            await b.until_known("a", online=True)
            await talker.advertise("later", STRING)
            changes: list[str] = []
            async with asyncio.timeout(20):
                async for event in events:
                    if event.name == "/later":
                        break
                    if event.name == "/chatter":
                        changes.append(event.change.value)
        # On a busy machine heartbeats may be late once more: another outage.
        anew = ["publisher removed", "publisher added"]
        assert changes == ([] if reachable else anew * max(1, len(changes) // 2))


async def test_offline_master_gives_way_to_one_that_replaces_it(network: DiscoveryNetwork) -> None:
    """A machine that comes back at other ports is another master, with nodes of the same names."""
    async with network.machine() as b, AsyncExitStack() as former:
        a = await former.enter_async_context(network.machine(name="a"))
        talker = await former.enter_async_context(node("talker", a.uri))
        await talker.advertise("chatter", STRING)
        await talker.advertise_service("ask", "roscpp/Empty", lambda _: {})
        await b.until(lambda graph: graph.service("/ask") is not None)
        a.discovery._socket.send_to = lambda *_: None  # type: ignore[method-assign]  # no good-bye either
        await b.until_known("a", online=False)
        async with network.machine(name="next") as other, node("talker", other.uri) as second:
            await second.advertise("chatter", STRING)
            await second.advertise_service("ask", "roscpp/Empty", lambda _: {})
            await b.until(lambda graph: graph.publishers("/chatter") == {"/talker": second.uri})
            await b.until(lambda graph: graph.service("/ask") == second.service_uri)
            assert not second.is_shutdown


async def test_node_that_took_a_name_meanwhile_stays(network: DiscoveryNetwork) -> None:
    """What is registered again when a master is back must not displace a node that was started here."""
    async with (
        network.machine() as b,
        network.machine(name="a") as a,
        node("talker", a.uri) as talker,
        node("other", a.uri) as other,
    ):
        await talker.advertise("chatter", STRING)
        await b.until(lambda graph: "/chatter" in graph.topic_types)
        send = a.discovery._socket.send_to
        a.discovery._socket.send_to = lambda *_: None  # type: ignore[method-assign]  # the network is gone
        await b.until_known("a", online=False)
        async with node("talker", b.uri) as here:
            await here.advertise("own", STRING)
            a.discovery._socket.send_to = send  # type: ignore[method-assign]  # and back
            await b.until_known("a", online=True)
            await other.advertise("later", STRING)
            await b.until(lambda graph: "/later" in graph.topic_types)
            assert b.graph.nodes["/talker"] == here.uri
            assert not here.is_shutdown


async def test_registration_without_answer_is_taken_back(
    network: DiscoveryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A master that was too busy to answer may have registered everything."""
    entry = Registration(RegistrationKind.PUBLISHER, "/t", "/n", "http://10.0.0.1:1/", STRING)
    origin = "http://10.0.0.1:11311/"
    original = multicall_as

    async def unanswered(*arguments: Any) -> list[Any]:
        await original(*arguments)
        monkeypatch.setattr(registrar, "multicall_as", original)
        raise MasterUnreachableError(origin, "no answer")

    async with (
        Core(port=0) as core,
        node("sync", core.uri) as sync,
        RpcClient() as rpc,
        TaskScope() as tasks,
    ):
        registrations = Registrar(sync, MasterClient(core.uri, sync.name, sync.uri, rpc), tasks)
        monkeypatch.setattr(registrar, "multicall_as", unanswered)
        with pytest.raises(MasterUnreachableError):
            await registrations.hold(origin, {entry}, {})
        assert await registrations.hold(origin, {entry}, {}) == []
        assert registrations.held == {origin: {entry}}
        await registrations.release(origin)
        assert not core.graph.publishers("/t")


async def test_record_of_registrations_is_in_parts(network: DiscoveryNetwork) -> None:
    """With a thousand masters, a change at one must not write what all have."""
    async with (
        Core(port=0) as core,
        node("sync", core.uri) as sync,
        RpcClient() as rpc,
        TaskScope() as tasks,
    ):
        master = MasterClient(core.uri, sync.name, sync.uri, rpc)
        registrations = Registrar(sync, master, tasks)
        origins = [f"http://10.0.0.{number}:11311/" for number in range(5)]
        for number, origin in enumerate(origins):
            entries = {Registration(RegistrationKind.PUBLISHER, f"/t{number}", f"/n{number}", origin, STRING)}
            await registrations.hold(origin, entries, {})
        record = core.graph.parameters.get("/sync/registrations")
        assert isinstance(record, dict)
        assert sorted(json.loads(text)[0][2] for text in record.values()) == [
            "/n0",
            "/n1",
            "/n2",
            "/n3",
            "/n4",
        ]
        await registrations.release(origins[0])
        record = core.graph.parameters.get("/sync/registrations")
        assert sorted(json.loads(text)[0][2] for text in record.values()) == ["/n1", "/n2", "/n3", "/n4"]

        former = Registration(RegistrationKind.PUBLISHER, "/old", "/old", origins[0], STRING)
        for text in ("nonsense", json.dumps([["publisher", "/old", "/old", origins[0], STRING]])):
            await master.call("setParam", "/sync/registrations", text)  # as a former release
            core.graph.register_publisher("/old", STRING, former.node, former.uri)
            await Registrar(sync, master, tasks).take_back_leftovers()
            assert not core.graph.parameters.has("/sync/registrations")
        assert not core.graph.publishers("/old")


async def test_nodes_of_one_name_do_not_kill_each_other(
    network: DiscoveryNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    async with (
        network.machine() as a,
        network.machine() as b,
        node("camera", a.uri) as one,
        node("camera", b.uri) as other,
        node("talker", a.uri) as talker,
    ):
        await one.advertise("left", STRING)
        await other.advertise("right", STRING)
        await talker.advertise("chatter", STRING)
        await b.until(lambda graph: "/chatter" in graph.topic_types)
        await asyncio.sleep(0.5)
        assert not one.is_shutdown
        assert not other.is_shutdown
        assert "/left" not in b.graph.topic_types
        assert "node /camera" in caplog.text


async def test_nodes_of_one_name_can_be_told_apart(network: DiscoveryNetwork) -> None:
    async with (
        network.machine() as a,
        network.machine(distinct_names=True) as b,
        node("camera", a.uri) as one,
        node("camera", b.uri) as other,
    ):
        await one.advertise("left", STRING)
        await other.advertise("right", STRING)
        await b.until(lambda graph: "/left" in graph.topic_types)
        (name,) = b.graph.publishers("/left")
        assert name.startswith("/camera_at_127_0_0_1_")
        assert not one.is_shutdown
        assert not other.is_shutdown


async def test_a_restarted_node_is_registered_anew(network: DiscoveryNetwork) -> None:
    async with (
        network.machine() as a,
        network.machine() as b,
        node("listener", b.uri) as listener,
    ):
        heard = await listener.subscribe("chatter", STRING)
        for word in ("first", "second"):
            async with node("talker", a.uri) as talker:
                publisher = await talker.advertise("chatter", STRING)
                await publisher.wait_for_subscribers(timeout=20)
                publisher.publish(data=word)
                async with asyncio.timeout(60):
                    assert (await anext(aiter(heard))).data == word


async def test_a_restarted_master_is_known_by_its_run(network: DiscoveryNetwork) -> None:
    """In a container, the next master may have the number of the process of the one before."""
    port = free_port()
    uri = f"http://127.0.0.1:{port}/"
    async with network.machine() as a, node("talker", a.uri) as talker, AsyncExitStack() as stack:
        await talker.advertise("chatter", STRING)
        async with Core(port=port) as first:
            await stack.enter_async_context(network.machine(uri))
            await first.wait_until(lambda graph: bool(graph.publishers("/chatter")), timeout=20)
        async with Core(port=port) as second:
            await second.wait_until(lambda graph: bool(graph.publishers("/chatter")), timeout=30)
            await second.wait_until(
                lambda graph: graph.parameters.has("/master_discovery/masteruri"), timeout=30
            )
            await stack.aclose()


async def test_next_synchronization_cleans_up_after_killed_one(
    network: DiscoveryNetwork,
) -> None:
    """What a killed synchronization left is taken back by the next."""
    from rce.ros.multimaster.sync import MasterSync, SyncSettings

    async with network.machine() as b:
        async with network.machine() as a, node("talker", a.uri) as talker:
            await talker.advertise("chatter", STRING)
            await b.until(lambda graph: "/chatter" in graph.topic_types)
            b.sync.registrar.held.clear()  # as if it were killed: it takes nothing back
        await b.sync.__aexit__(None, None, None)
        assert "/chatter" in b.graph.topic_types
        async with MasterSync(SyncSettings(b.uri)):
            await b.until(lambda graph: "/chatter" not in graph.topic_types)


@pytest.mark.parametrize("first", ["is not answered", "loses its connection"])
async def test_busy_remote_subscriber_is_told_later(first: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own master does not know the publishers of this graph: nothing else tells it of them."""
    monkeypatch.setattr(registrar, "UPDATE_TIMEOUT", 0.5)
    calls: asyncio.Queue[bytes] = asyncio.Queue()
    loses = first == "loses its connection"
    async with (
        asyncio.timeout(30),
        Core(port=0) as core,
        node("talker", core.uri) as talker,
        node("sync", core.uri) as sync,
        answering_second_call(calls, loses=loses) as uri,
        RpcClient() as rpc,
        TaskScope() as tasks,
    ):
        await talker.advertise("/t", STRING)
        registrations = Registrar(sync, MasterClient(core.uri, sync.name, sync.uri, rpc), tasks)
        remote = Registration(RegistrationKind.SUBSCRIBER, "/t", "/busy", uri, STRING)
        await registrations.hold("http://remote:11311/", {remote}, {})
        while calls.qsize() < 2:
            await asyncio.sleep(0.01)
        told = calls.get_nowait()
        assert talker.uri.encode() in told
        assert calls.get_nowait() == told
