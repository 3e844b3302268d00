"""One discovery and its neighbours: lists, changes, unicast, a core in the same process, the programs."""

from __future__ import annotations

import asyncio
import gc
import shutil
import sys
from contextlib import AsyncExitStack
from pathlib import Path

import aiohttp
import pytest
from support.engine import Program
from support.multimaster import STRING, DiscoveryNetwork, node
from support.ports import free_ports

from rce.ros.core import Core
from rce.ros.errors import MasterUnreachableError, RemoteFaultError, ServiceFaultError
from rce.ros.multimaster import messages
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.errors import NoDiscoveryError
from rce.ros.multimaster.listing import list_masters, masters_known_at
from rce.ros.multimaster.rpc import MAX_TYPES
from rce.ros.node import ServiceClient
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce.ros.xmlrpc.codec import encode_call


def program(name: str, *arguments: str, folder: Path) -> Program:
    text = f"import typer; from rce.ros.cli.{name} import {name}; typer.run({name})"
    return Program(name, [sys.executable, "-c", text, *arguments], {"ROS_IP": "127.0.0.1"}, folder)


async def test_a_core_of_the_same_process_is_watched(network: DiscoveryNetwork) -> None:
    async with Core(port=0) as core:
        settings = network.settings(core.uri, rosmaster_hz=0.01)
        async with Discovery(settings, core=core) as discovery, node("n", core.uri) as talker:
            with discovery.watch() as events:
                await talker.advertise("said", STRING)
                async with asyncio.timeout(60):
                    async for _ in events:
                        if discovery.info is not None and "/said" in discovery.info.publishers:
                            break
            assert discovery.info is not None
            assert discovery.info.nodes["/n"].is_local


async def test_web_page_cannot_ask_a_discovery(network: DiscoveryNetwork) -> None:
    async with (
        Core(port=0) as core,
        Discovery(network.settings(core.uri)) as discovery,
        aiohttp.ClientSession() as browser,
    ):
        for headers, status in (({"Origin": "https://evil.example"}, 403), ({}, 200)):
            call = encode_call("masterInfo", ())
            async with browser.post(discovery.monitor_uri, data=call, headers=headers) as reply:
                assert reply.status == status


async def test_question_for_masters_leaves_no_client(network: DiscoveryNetwork) -> None:
    """A synchronization asks every few seconds, for as long as it runs."""

    def clients() -> int:
        gc.collect()
        return sum(isinstance(one, ServiceClient) for one in gc.get_objects())

    async with (
        Core(port=0) as core,
        Discovery(network.settings(core.uri, name="a")) as discovery,
        node("n", core.uri, types=messages.registry()) as asking,
        RpcClient() as rpc,
        asyncio.timeout(60),
    ):
        master = MasterClient(core.uri, asking.name, asking.uri, rpc)
        while discovery.info is None:
            await asyncio.sleep(0.01)
        before = clients()
        for _ in range(5):
            assert [one.name for one in await masters_known_at(asking, master)] == ["a"]
        assert clients() == before


async def test_masters_and_changes_are_shown_in_the_graph(network: DiscoveryNetwork) -> None:
    async with Core(port=0) as a, Core(port=0) as b:
        with pytest.raises(NoDiscoveryError):
            await list_masters(a.uri)
        async with Discovery(network.settings(a.uri, name="a")) as discovery:
            watcher = node("watcher", a.uri, types=messages.registry())
            async with watcher as watching, RpcClient() as rpc:
                changes = await watching.subscribe("/master_discovery/changes", messages.MASTER_STATE)
                links = await watching.subscribe("/master_discovery/linkstats", messages.LINK_STATES)
                await changes.wait_for_publishers(timeout=20)
                async with asyncio.timeout(60), Discovery(network.settings(b.uri, name="b")):
                    async for change in changes:
                        if change.state == "new" and change.master.name == "b":
                            break
                    async for stats in links:
                        if {link.destination for link in stats.links} == {"a", "b"}:
                            break
                    assert {master.name: master.online for master in await list_masters(a.uri)} == {
                        "a": True,
                        "b": True,
                    }
                async with asyncio.timeout(60):
                    async for change in changes:
                        if change.state == "removed":
                            break
                assert change.master.name == "b"
                contacts = await rpc.call(discovery.monitor_uri, "masterContacts", ())
                assert contacts[1:4] == [a.uri, "a", "/master_discovery"]
                assert float(contacts[0]) > 0
                assert (await rpc.call(discovery.monitor_uri, "getCurrentTime", ()))[0] == a.uri
                (pair,) = await rpc.call(discovery.monitor_uri, "getTopicsMd5sum", ([STRING, "no/Such"],))
                assert pair == [STRING, "992ce8a1687cec8c8bd883ec73ca41d1"]
    with pytest.raises(MasterUnreachableError):
        await list_masters(a.uri)


async def test_checksums_are_answered_from_definitions_read_before(
    network: DiscoveryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any host may ask for many: reading all definitions for each would stop the heartbeats meanwhile."""
    async with Core(port=0) as core, Discovery(network.settings(core.uri)) as discovery, RpcClient() as rpc:
        monkeypatch.delattr(messages, "registry")
        asked = [STRING] * 2 * MAX_TYPES
        pairs = await rpc.call(discovery.monitor_uri, "getTopicsMd5sum", (asked,))
        assert pairs == [[STRING, "992ce8a1687cec8c8bd883ec73ca41d1"]]
        many = [f"no/Such{number}" for number in range(MAX_TYPES + 1)]
        with pytest.raises(RemoteFaultError, match="at most 1000 message types"):
            await rpc.call(discovery.monitor_uri, "getTopicsMd5sum", (many,))


async def test_an_endless_filter_does_not_keep_a_discovery_busy(network: DiscoveryNetwork) -> None:
    """Any host may send one: comparing all names with it would stop the heartbeats meanwhile."""
    stars = rf"\A/t{'.*' * 200_000}x\Z"
    many = "|".join(rf"\A/a{number}.*b\Z" for number in range(40_000))
    async with Core(port=0) as core, RpcClient() as rpc:
        for number in range(100):
            api = f"http://127.0.0.1:1/{number}"
            await rpc.call(core.uri, "registerPublisher", (f"/n{number}", f"/t{number}", STRING, api))
        async with Discovery(network.settings(core.uri)) as discovery:
            for expression in (many, stars):
                lists = [False, *[expression] * 10]
                answer = await rpc.call(discovery.monitor_uri, "masterInfoFiltered", (lists,), timeout=5)
                assert {f"/t{number}" for number in range(100)} <= {name for name, _ in answer[4]}


async def test_origins_of_nodes_outlive_a_busy_synchronization(network: DiscoveryNetwork) -> None:
    """Nodes of other masters are not told as this master's own while a synchronization does not answer."""
    far, api = "http://far:11311/", "http://127.0.0.1:1/"
    topic = {"topic": "/t", "node": "/far", "nodeuri": api}
    info = {"masteruri": far, "nodes": ["/far"], "publisher": [topic], "subscriber": [], "services": []}
    is_busy = True

    def answer(_request: object) -> dict[str, object]:
        if is_busy:
            raise ServiceFaultError("/sync/get_sync_info", "busy")
        return {"hosts": [info]}

    async with Core(port=0) as core, RpcClient() as rpc, AsyncExitStack() as stack:
        sync = await stack.enter_async_context(node("sync", core.uri, types=messages.registry()))
        await sync.advertise_service("~get_sync_info", messages.GET_SYNC_INFO, answer)
        await rpc.call(core.uri, "registerPublisher", ("/far", "/t", STRING, api))
        discovery = await stack.enter_async_context(Discovery(network.settings(core.uri, name="a")))

        async def until(origin: str, topic: str = "/t") -> None:
            async with asyncio.timeout(60):
                while discovery.info is None or topic not in discovery.info.publishers:
                    await asyncio.sleep(0.02)
                while discovery.info.nodes["/far"].master_uri != origin:
                    await asyncio.sleep(0.02)

        await until(core.uri)
        is_busy = False
        await until(far)
        is_busy = True
        await rpc.call(core.uri, "registerPublisher", ("/near", "/u", STRING, "http://127.0.0.1:2/"))
        await until(far, "/u")


async def test_installed_messages_of_fkie_win(
    network: DiscoveryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later ones may have a field more: a program that has them would not understand ours."""
    package = tmp_path / "fkie_multimaster_msgs"
    shutil.copytree(Path(messages.__file__).with_name("share") / package.name, package)
    with (package / "msg" / "LinkState.msg").open("a") as definition:
        definition.write("uint8 more\n")
    monkeypatch.setenv("RCE_PACKAGE_PATH", str(tmp_path))
    async with (
        Core(port=0) as core,
        Discovery(network.settings(core.uri, name="a")),
        node("watcher", core.uri, types=messages.registry()) as watching,
        asyncio.timeout(60),
    ):
        links = await watching.subscribe("/master_discovery/linkstats", messages.LINK_STATES)
        async for stats in links:
            if stats.links:
                break
        assert stats.links[0].destination == "a"
        assert abs(stats.links[0].last_heartbeat.to_sec() - stats.header.stamp.to_sec()) < 5
        assert stats.links[0].more == 0


async def test_robot_hosts_find_each_other_without_multicast(network: DiscoveryNetwork) -> None:
    ports = free_ports(2)
    async with Core(port=0) as a, Core(port=0) as b:
        first, second = (
            network.settings(
                core.uri,
                name=name,
                mcast_port=own,
                send_mcast=False,
                listen_mcast=False,
                robot_hosts=(f"127.0.0.1:{other}",),
            )
            for core, name, own, other in ((a, "a", ports[0], ports[1]), (b, "b", ports[1], ports[0]))
        )
        async with Discovery(first) as one, Discovery(second) as two, asyncio.timeout(60):
            for discovery in (one, two):
                while {master.name for master in discovery.masters} != {"a", "b"}:
                    await asyncio.sleep(0.02)


async def test_a_robot_host_may_be_a_name(network: DiscoveryNetwork, tmp_path: Path) -> None:
    """uvloop's sockets send to addresses only; a name that cannot be resolved is told of and does no harm."""
    port, rpc_port = free_ports(2)
    async with Core(port=0) as a, Core(port=0) as b:
        settings = network.settings(b.uri, name="b", mcast_port=port, send_mcast=False, listen_mcast=False)
        running = program(
            "discovery",
            *("--master-uri", a.uri, "--name", "a", "--heartbeat-hz", "10", "--no-listen-mcast"),
            *("--no-send-mcast", "--mcast-group", "226.0.0.0@127.0.0.1", "--rpc-port", str(rpc_port)),
            *("--mcast-port", str(network.port), "--robot-host", f"localhost:{port}"),
            *("--robot-host", "no-such-robot.invalid"),
            folder=tmp_path,
        )
        async with Discovery(settings) as other:
            await running.start(ready="no-such-robot.invalid")
            try:
                async with asyncio.timeout(30):
                    while "a" not in {master.name for master in other.masters}:
                        await asyncio.sleep(0.02)
            finally:
                assert await running.stop() == 0
        assert "Traceback" not in running.output()


async def test_the_relay_program(tmp_path: Path) -> None:
    async with Core(port=0) as core, node("n", core.uri) as talker:
        (await talker.advertise("from", STRING, latch=True)).publish(data="kept")
        heard = await talker.subscribe("to", STRING)
        running = program("relay", "/from", "/to", "--latch", "--master-uri", core.uri, folder=tmp_path)
        await running.start(ready="")
        try:
            async with asyncio.timeout(60):
                assert (await anext(aiter(heard))).data == "kept"
        finally:
            assert await running.stop() == 0
        await core.wait_until(lambda graph: graph.publishers("/to") == {}, timeout=20)


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("relay", ("/a", "/a"), "to itself"),
        ("relay", ("/a", "/b", "--throttle", "0"), "above 0 Hz"),
        ("sync", ("--as", "no way"), "is not a namespace"),
        ("sync", ("--relay", ":5"), "HOST:PORT"),
        ("discovery", ("--heartbeat-hz", "30"), "at most 25.5"),
        ("discovery", ("--list", "--master-uri", "http://127.0.0.1:1/"), "does not answer"),
    ],
)
async def test_programs_say_what_is_wrong(
    tmp_path: Path, name: str, arguments: tuple[str, ...], words: str
) -> None:
    running = program(name, *arguments, folder=tmp_path)
    await running.start(ready="")
    assert running.process is not None
    async with asyncio.timeout(30):
        assert await running.process.wait() == 1
    assert words in running.output()
    assert "Traceback" not in running.output()
