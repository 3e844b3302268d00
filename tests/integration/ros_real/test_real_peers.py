"""rospy and roscpp nodes with ours at the other end, at our core and at a real one."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Protocol

import pytest
from support.ports import free_port
from support.ros_nodes import MakeGraphNode, say_until_echoed
from support.ros_real import Graph, our_graph

from rce.ros.errors import ServiceFaultError
from rce.ros.node import Node

pytestmark = [pytest.mark.needs("rospy"), pytest.mark.timeout(300)]

STRING = "std_msgs/String"
LANGUAGES = ["rospy", pytest.param("roscpp", marks=pytest.mark.needs("roscpp"))]


class Start(Protocol):
    """Starts a peer; see :func:`start`."""

    def __call__(
        self, graph: Graph, *arguments: str
    ) -> AbstractAsyncContextManager[tuple[asyncio.subprocess.Process, str]]: ...


@pytest.fixture
def start(request: pytest.FixtureRequest, language: str) -> Start:
    """Start the peer: ``async with start(graph, "_word:=x") as (process, name): ...``."""
    argv = request.getfixturevalue(f"{language}_peer")

    @contextlib.asynccontextmanager
    async def running(graph: Graph, *arguments: str) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
        async with graph.program(*argv, *arguments) as process:
            await graph.until(lambda: graph.service("/peer_ask"), what="the peer is up")
            yield process, f"/{language}_peer"

    return running


@pytest.mark.parametrize("language", LANGUAGES)
async def test_topics_services_and_parameters(
    graph: Graph, make_node: MakeGraphNode, start: Start, language: str
) -> None:
    async with make_node(graph, "ours") as node, start(graph, "_word:=word") as (process, name):
        latched: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await node.subscribe_serialized("peer_latched", STRING, lambda *message: latched.put_nowait(message))
        payload, is_latched = await asyncio.wait_for(latched.get(), 20)
        assert (payload[4:], is_latched) == (b"kept word", True)

        await echoes(node)

        client = node.service_client("peer_set", "std_srvs/SetBool")
        assert (await client.call({"data": True}, timeout=20)).message == "done"
        assert await node.get_param(f"{name}/set") is True
        with pytest.raises(ServiceFaultError, match="as asked" if language == "rospy" else None):
            await client.call({"data": False}, timeout=20)
        await node.advertise_service(
            "ours_trigger", "std_srvs/Trigger", lambda _: {"success": True, "message": "ü"}
        )
        for persistent in (True, False):
            asking = node.service_client("peer_ask", "std_srvs/Trigger", persistent=persistent)
            answer = await asking.call({}, timeout=20)
            assert (answer.success, answer.message) == (True, f"{language} got: ü")

        if language == "rospy":  # Debian's roscpp answers and then crashes, for any client and any core
            get = node.service_client(f"{name}/get_loggers", "roscpp/GetLoggers")
            assert (await get.call({}, timeout=20)).loggers
        await node.service_client("peer_set", "std_srvs/SetBool").call({"data": True}, timeout=20)
        assert name in await graph.tool("rosnode", "list")
        process.send_signal(signal.SIGINT)
        await asyncio.wait_for(process.wait(), 20)
        await graph.until(lambda: is_gone(graph, name), what="the peer has left the graph")


async def echoes(node: Node) -> None:
    """Send messages of several sizes to the peer and wait for them to come back."""
    echo = await node.subscribe("peer_out", STRING)
    say = await node.advertise("peer_in", STRING)
    async with asyncio.timeout(60):
        await say_until_echoed(say, echo)
        for text in ("", "hello", "x" * 70_000, "x" * 3_000_000, "ü" * 1000):
            say.publish(data=text)
            assert (await anext(aiter(echo))).data == text


async def is_gone(graph: Graph, name: str) -> bool:
    """Whether a node has no topic or service; a real master may remember its name indefinitely."""
    state = await graph.ask("getSystemState")
    return not any(name in nodes for part in state for _, nodes in part)


@pytest.mark.needs("roscpp")
@pytest.mark.parametrize("language", ["roscpp"])
async def test_a_subscriber_that_offers_udp_first_gets_tcp(
    ours: Graph, make_node: MakeGraphNode, start: Start
) -> None:
    async with make_node(ours, "ours") as node, start(ours, "_udp:=true"):
        await echoes(node)
        assert "TCPROS" in await ours.tool("rosnode", "info", "/ours")


@pytest.mark.parametrize("language", LANGUAGES)
async def test_a_killed_node_comes_back(
    graph: Graph, make_node: MakeGraphNode, start: Start, language: str
) -> None:
    async with make_node(graph, "ours") as node:
        for _ in range(2):
            async with start(graph) as (process, name):
                await echoes(node)
                os.kill(process.pid, signal.SIGKILL)
                await process.wait()
        answer = await graph.tool("rosnode", "cleanup", stdin="y\n")
        assert name in answer
        assert await is_gone(graph, name)
        assert await graph.node("/ours") == node.uri


@pytest.mark.parametrize("language", LANGUAGES)
async def test_nodes_of_one_name(
    request: pytest.FixtureRequest, graph: Graph, start: Start, language: str
) -> None:
    """The newer one ends the older one; a real master ends both if the older one registers something late."""
    may_end_both = request.node.callspec.params["graph"] == "roscore"
    async with start(graph, "_word:=one") as (older, name):
        uri, argv = await graph.node(name), older_argv(older)
        for _ in range(3 if may_end_both else 1):
            async with graph.program(*argv) as newer:
                await asyncio.wait_for(older.wait(), 40)

                async def is_new_or_ended(newer: asyncio.subprocess.Process = newer) -> bool:
                    return newer.returncode is not None or await graph.node(name) not in (None, uri)

                await graph.until(is_new_or_ended, what="the newer node has taken the name")
                if newer.returncode is None:
                    return
        raise AssertionError("the newer node was ended too")


def older_argv(process: asyncio.subprocess.Process) -> list[str]:
    import psutil

    return psutil.Process(process.pid).cmdline()


@pytest.mark.parametrize("language", ["rospy"])
async def test_any_message_carries_its_type(
    ours: Graph, make_node: MakeGraphNode, start: Start, language: str
) -> None:
    async with make_node(ours, "ours") as node, start(ours):
        kinds = await node.subscribe("peer_kinds", STRING)
        publisher = await node.advertise("peer_any", "geometry_msgs/PoseStamped")
        await publisher.wait_for_subscribers(timeout=20)
        publisher.publish()
        assert (await asyncio.wait_for(anext(aiter(kinds)), 20)).data == "geometry_msgs/PoseStamped"


@pytest.mark.parametrize("language", LANGUAGES)
async def test_our_core_is_killed_and_restarted(
    make_node: MakeGraphNode, start: Start, language: str, tmp_path: Path
) -> None:
    """Connections live on without a core; our nodes register again at the next one, real nodes do not."""
    port = free_port()

    async def publishers() -> list[str]:
        return await graph.publishers("/peer_in")

    async with contextlib.AsyncExitStack() as stack:
        async with our_graph(tmp_path, port) as graph:
            node = await stack.enter_async_context(make_node(graph, "ours"))
            await stack.enter_async_context(start(graph))
            echo = await node.subscribe("peer_out", STRING)
            say = await node.advertise("peer_in", STRING)
            await say_until_echoed(say, echo)
        for life in ("no core", "the next core"):
            say.publish(data=life)
            assert (await asyncio.wait_for(anext(aiter(echo)), 20)).data == life
            if life == "no core":
                graph = await stack.enter_async_context(our_graph(tmp_path, port))
                await graph.until(publishers, what="ours has registered again")
        assert await graph.node("/ours") == node.uri
