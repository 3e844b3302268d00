"""A peer that is made of the facts of fkie's wire, and ours: they find and synchronize each other."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from support.multimaster import STRING, DiscoveryNetwork, node
from support.ports import free_ports

from rce.ros.core import Core

SCRIPT = Path(__file__).parents[2] / "support" / "fkie_peer.py"


@asynccontextmanager
async def fkie_peer(master_uri: str, mcast_port: int) -> AsyncIterator[asyncio.subprocess.Process]:
    (rpc_port,) = free_ports(1)
    arguments = [master_uri, str(rpc_port), str(mcast_port), "127.0.0.1"]
    peer = await asyncio.create_subprocess_exec(
        sys.executable, "-I", str(SCRIPT), *arguments, stdout=asyncio.subprocess.PIPE
    )
    try:
        yield peer
    finally:
        if peer.returncode is None:
            peer.kill()
        await peer.communicate()


async def line(peer: asyncio.subprocess.Process) -> list[str]:
    assert peer.stdout is not None
    async with asyncio.timeout(60):
        return (await peer.stdout.readline()).decode().split()


async def test_it_and_ours_find_and_synchronize_each_other(network: DiscoveryNetwork) -> None:
    async with (
        Core(port=0) as theirs,
        network.machine(name="ours") as ours,
        fkie_peer(theirs.uri, network.port) as peer,
        node("their_node", theirs.uri) as their_node,
        node("our_node", ours.uri) as our_node,
    ):
        assert await line(peer) == ["found", "ours", ours.uri, "10.0"]
        said, answered = (
            await their_node.advertise("said", STRING),
            await our_node.advertise("answered", STRING),
        )
        heard, got = await our_node.subscribe("said", STRING), await their_node.subscribe("answered", STRING)
        await our_node.advertise_service("ours", "roscpp/GetLoggers", lambda _: {"loggers": [{"name": "o"}]})
        await their_node.advertise_service(
            "theirs", "roscpp/GetLoggers", lambda _: {"loggers": [{"name": "t"}]}
        )
        await ours.until(lambda graph: "/their_node" in graph.publishers("/said"))
        await theirs.wait_until(lambda graph: "/our_node" in graph.publishers("/answered"), timeout=20)
        for publisher, subscriber in ((said, heard), (answered, got)):
            await publisher.wait_for_subscribers(timeout=20)
            publisher.publish(data="across")
            async with asyncio.timeout(60):
                assert (await anext(aiter(subscriber))).data == "across"
        await ours.until(lambda graph: graph.service("/theirs") is not None)
        await theirs.wait_until(lambda graph: graph.service("/ours") is not None, timeout=20)
        answer = await our_node.service_client("theirs", "roscpp/GetLoggers").call({}, timeout=20)
        assert answer.loggers[0].name == "t"
        answer = await their_node.service_client("ours", "roscpp/GetLoggers").call({}, timeout=20)
        assert answer.loggers[0].name == "o"
        assert not any(name.startswith("/master_") for name in theirs.graph.topic_types)

        peer.send_signal(signal.SIGTERM)
        await ours.until(lambda graph: "/their_node" not in graph.nodes)
        assert all(master.name != "fkie" for master in ours.discovery.masters)


async def test_it_learns_that_ours_leaves(network: DiscoveryNetwork) -> None:
    async with (
        Core(port=0) as theirs,
        network.machine(name="ours") as ours,
        fkie_peer(theirs.uri, network.port) as peer,
        node("our_node", ours.uri) as our_node,
    ):
        await our_node.advertise("answered", STRING)
        await theirs.wait_until(lambda graph: "/answered" in graph.topic_types, timeout=20)
        await ours.discovery.__aexit__(None, None, None)
        assert (await line(peer))[0] == "found"
        assert (await line(peer))[0] == "lost"
        await theirs.wait_until(lambda graph: "/answered" not in graph.topic_types, timeout=20)


async def test_its_silence_is_noticed(network: DiscoveryNetwork) -> None:
    async with (
        Core(port=0) as theirs,
        network.machine(remove_after=3.0) as ours,
        node("their_node", theirs.uri) as their_node,
    ):
        await their_node.advertise("said", STRING)
        async with fkie_peer(theirs.uri, network.port) as peer:
            await ours.until(lambda graph: "/said" in graph.topic_types)
            os.kill(peer.pid, signal.SIGKILL)
            await ours.until_known("fkie", online=False)
            assert "/said" in ours.graph.topic_types, "it may be back"
            await ours.until(lambda graph: "/said" not in graph.topic_types)
