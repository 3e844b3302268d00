"""Real masters and rospy nodes on either side, and masters and discoveries that are killed."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from pathlib import Path

import psutil
import pytest
from support.engine import command_line
from support.multimaster import STRING, DiscoveryNetwork, node, process, real_master, ros_environment
from support.ports import free_port, free_ports
from support.ros_nodes import say_until_echoed
from support.roscpp_programs import compiled

from rce.ros.core import Graph
from rce.ros.node import Node, Publisher

ROSCPP_PEER = Path(__file__).parents[1] / "ros_real" / "programs" / "roscpp_peer.cpp"

TALKER = """
import rospy
from std_msgs.msg import String
rospy.init_node("rospy_talker")
publisher = rospy.Publisher("chatter", String, queue_size=10)
rate = rospy.Rate(20)
while not rospy.is_shutdown():
    publisher.publish("from rospy")
    rate.sleep()
"""

LISTENER = """
import rospy
from std_msgs.msg import String
rospy.init_node("rospy_listener")
rospy.Subscriber("orders", String, lambda message: print("heard", message.data, flush=True))
rospy.spin()
"""


@asynccontextmanager
async def rospy_program(text: str, uri: str, folder: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    script = folder / f"program{len(list(folder.glob('program*')))}.py"
    script.write_text(text)
    async with process("/usr/bin/python3", str(script), env=ros_environment(uri, folder)) as started:
        yield started


async def heard(program: asyncio.subprocess.Process, text: str) -> None:
    assert program.stdout is not None
    async with asyncio.timeout(90):
        while (await program.stdout.readline()).decode().strip() != f"heard {text}":
            pass


async def say_until_heard(orders: Publisher, program: asyncio.subprocess.Process, text: str) -> None:
    """Say it again and again: a discovery that hears nothing for a while lets go of subscribers."""
    hearing = asyncio.ensure_future(heard(program, text))
    while not hearing.done():
        orders.publish(data=text)
        await asyncio.wait([hearing], timeout=0.2)
    await hearing


@pytest.mark.needs("rospy")
@pytest.mark.parametrize("both_real", [False, True])
async def test_rospy_nodes_at_a_real_master(
    network: DiscoveryNetwork, tmp_path: Path, both_real: bool
) -> None:
    async with (
        real_master(tmp_path) as real,
        _second(both_real, tmp_path) as second,
        network.machine(real, name="real"),
        network.machine(second, name="second") as other,
        rospy_program(TALKER, real, tmp_path),
        rospy_program(LISTENER, real, tmp_path) as listener,
        node("ours", other.uri) as ours,
    ):
        said = await ours.subscribe("chatter", STRING)
        orders = await ours.advertise("orders", STRING)
        async with asyncio.timeout(90):
            assert (await anext(aiter(said))).data == "from rospy"
            await orders.wait_for_subscribers()
        await say_until_heard(orders, listener, "go")


@asynccontextmanager
async def _second(is_real: bool, folder: Path) -> AsyncIterator[str | None]:
    if not is_real:
        yield None
        return
    async with real_master(folder) as uri:
        yield uri


@pytest.mark.needs("rospy")
async def test_rospy_listens_again_after_lost_talker(network: DiscoveryNetwork, tmp_path: Path) -> None:
    """Rospy listens again after its talker was lost for a while."""
    async with (
        real_master(tmp_path) as real,
        network.machine(real, name="real") as far,
        network.machine(name="near") as near,
        rospy_program(LISTENER, real, tmp_path) as listener,
        node("ours", near.uri) as ours,
    ):
        orders = await ours.advertise("orders", STRING)
        await orders.wait_for_subscribers(timeout=40)
        await say_until_heard(orders, listener, "one")
        send = near.discovery._socket.send_to
        near.discovery._socket.send_to = lambda *_: None  # type: ignore[method-assign]  # the network is gone
        await far.until_known("near", online=False)
        (link,) = orders._output.links
        link.connection.abort()
        near.discovery._socket.send_to = send  # type: ignore[method-assign]  # the network is back
        await far.until_known("near", online=True)
        await orders.wait_for_subscribers(timeout=60)
        await say_until_heard(orders, listener, "two")


@pytest.mark.needs("rospy")
async def test_a_killed_master_is_left_and_found_again(network: DiscoveryNetwork, tmp_path: Path) -> None:
    (port,) = free_ports(1)
    async with (
        network.machine(name="near") as near,
        real_master(tmp_path, port) as real,
        network.machine(real, name="far"),
        node("near_node", near.uri) as near_node,
    ):
        async with node("far_node", real) as far_node:
            await far_node.advertise("said", STRING)
            await near.until(lambda graph: "/said" in graph.topic_types)
        publisher = await near_node.advertise("answered", STRING)
        _kill_master(port)
        await near.until_known("far", online=False)
        async with real_master(tmp_path, port):
            await near.until_known("far", online=True)
            async with node("listener", real) as listener:
                got = await listener.subscribe("answered", STRING)
                await got.wait_for_publishers(timeout=20)
                publisher.publish(data="again")
                assert (await anext(aiter(got))).data == "again"


def _kill_master(port: int) -> None:
    children = psutil.Process().children(recursive=True)
    lines = {child: command_line(child) for child in children}
    (found,) = [child for child, line in lines.items() if "rosmaster" in " ".join(line) and str(port) in line]
    found.send_signal(signal.SIGKILL)


async def test_a_killed_discovery_is_noticed_and_taken_back(network: DiscoveryNetwork) -> None:
    from rce.ros.core import Core

    async with (
        network.machine(name="near", remove_after=1.0) as near,
        Core(port=0) as core,
        node("n", core.uri) as far,
    ):
        await far.advertise("said", STRING)
        for _ in range(2):
            async with _discovery_process(core.uri, network.port) as program:
                await near.until(lambda graph: "/said" in graph.topic_types)
                program.kill()
                await near.until(lambda graph: "/said" not in graph.topic_types)


@pytest.mark.parametrize("killed", ["core", "discovery"])
async def test_a_connection_outlives_killed_programs(network: DiscoveryNetwork, killed: str) -> None:
    """The graph of the subscriber keeps the publisher meanwhile: roscpp would close the connection."""
    port = free_port()
    core = partial(_program, "core", "from rce.ros.cli.core import core", "--port", str(port), "--no-log")
    uri = f"http://127.0.0.1:{port}/"
    discovery = partial(_discovery_process, uri, network.port, "--name", "far", "--rosmaster-hz", "10")
    programs = {"core": core, "discovery": discovery}
    async with (
        network.machine(name="near") as near,
        AsyncExitStack() as stack,
        Node("listener", argv=[], master_uri=near.uri, intra_process=False) as listener,
    ):
        running = {name: await stack.enter_async_context(make()) for name, make in programs.items()}
        far = await stack.enter_async_context(node("far", uri))
        publisher = await far.advertise("said", STRING)
        heard = await listener.subscribe("said", STRING)
        await publisher.wait_for_subscribers(timeout=30)
        (before,) = publisher._output.all_links

        running[killed].kill()
        await near.until_known("far", online=False)
        assert _is_published_by(far.uri, near.graph, name="/far")
        publisher.publish(data="meanwhile")
        async with asyncio.timeout(10):
            assert (await anext(aiter(heard))).data == "meanwhile"

        await stack.enter_async_context(programs[killed]())
        await near.until_known("far", online=True)
        await near.until(partial(_is_published_by, far.uri, name="/far"), timeout=30)
        publisher.publish(data="afterwards")
        async with asyncio.timeout(10):
            assert (await anext(aiter(heard))).data == "afterwards"
        assert publisher._output.all_links == [before], "it is not made anew"


@pytest.mark.needs("roscpp")
async def test_roscpp_stays_connected_to_nodes_of_a_dead_core(
    network: DiscoveryNetwork, tmp_path: Path
) -> None:
    """Roscpp closes a connection to a publisher that its master ceases to name."""
    port = free_port()
    uri = f"http://127.0.0.1:{port}/"
    core = _program("core", "from rce.ros.cli.core import core", "--port", str(port), "--no-log")
    discovery = _discovery_process(uri, network.port, "--name", "far", "--rosmaster-hz", "10")
    async with (
        network.machine(name="near") as near,
        core as running,
        discovery,
        process(str(compiled(ROSCPP_PEER, "roscpp")), env=ros_environment(near.uri, tmp_path)),
        node("listener", near.uri) as listener,
        node("far", uri) as far,
    ):
        publisher, echoed = (
            await far.advertise("peer_in", STRING),
            await listener.subscribe("peer_out", STRING),
        )
        await say_until_echoed(publisher, echoed)
        before = publisher._output.all_links
        running.kill()
        await near.until_known("far", online=False)
        await asyncio.sleep(1)  # nothing may happen
        publisher.publish(data="meanwhile")
        async with asyncio.timeout(10):
            assert (await anext(aiter(echoed))).data == "meanwhile"
        assert publisher._output.all_links == before


async def test_a_machine_that_vanished_comes_back_at_other_ports(network: DiscoveryNetwork) -> None:
    """Its master, its discovery and its nodes are others then; of the earlier ones, nothing is left."""
    from rce.ros.core import Core

    async with network.machine(name="near", remove_after=3.0) as near, node("ours", near.uri) as ours:
        heard = await ours.subscribe("said", STRING)
        seen = set()
        for life in ("first", "second"):
            async with (
                Core(port=0) as core,
                node("n", core.uri) as far,
                _discovery_process(core.uri, network.port, "--name", "far") as program,
            ):
                publisher = await far.advertise("said", STRING)
                await near.until(partial(_is_published_by, far.uri))
                await publisher.wait_for_subscribers(timeout=20)
                publisher.publish(data=life)
                async with asyncio.timeout(60):
                    assert (await anext(aiter(heard))).data == life
                seen |= {master.uri for master in near.discovery.masters if master.name == "far"}
                program.kill()
            await near.until(lambda graph: "/n" not in graph.nodes)
        assert len(seen) == 2
        assert not any(master.online for master in near.discovery.masters if master.name == "far")


def _is_published_by(uri: str, graph: Graph, name: str = "/n") -> bool:
    return graph.publishers("/said") == {name: uri}


@asynccontextmanager
async def _discovery_process(
    uri: str, mcast_port: int, *more: str
) -> AsyncIterator[asyncio.subprocess.Process]:
    async with _program(
        "discovery",
        "from rce.ros.cli.discovery import discovery",
        *("--master-uri", uri, "--mcast-group", "226.0.0.0@127.0.0.1", "--mcast-port", str(mcast_port)),
        *("--heartbeat-hz", "10", "--rpc-port", str(free_port()), *more),
    ) as program:
        yield program


@asynccontextmanager
async def _program(command: str, imported: str, *words: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A command of ``rce``, killed at the end."""
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", f"import typer; {imported}; typer.run({command})", *words),
        stdout=asyncio.subprocess.DEVNULL,
    )
    try:
        yield program
    finally:
        if program.returncode is None:
            program.kill()
        await program.wait()
