"""``rce-ros`` when the robot's own ROS master is restarted: everything is registered again and flows."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest
from integration.client.test_ros_bridge import EMPTY, STRING, config, program, write
from support.client_types import ros_string
from support.ports import free_port
from support.ros_real import GRAPHS

from rce.aio.tasks import TaskScope
from rce.model import Role
from rce.ros.core import Core
from rce.ros.node import Node
from rce_client.ros_bridge.bridge import Uplink, lay
from rce_client.ros_bridge.plan import Span

if TYPE_CHECKING:
    from pathlib import Path

    from integration.client.conftest import Engine
    from support.ros_real import Graph


async def everything_flows(graph: Graph, engine: Engine) -> None:
    async with asyncio.timeout(40), Node("robot", argv=(), master_uri=graph.uri) as node:
        publisher = await node.advertise("/say", STRING)
        subscriber = await node.subscribe("/hear", STRING)
        await node.advertise_service("/serve", EMPTY, lambda request: {"message": f"got {request.data}"})
        await publisher.wait_for_subscribers(1)
        await subscriber.wait_for_publishers(1)
        await node.wait_for_service("/ask")
        received = engine.end("say").received
        while not received.empty():
            received.get_nowait()
        publisher.publish(data="up")
        assert await received.get() == ros_string("up")
        engine.end("hear").port.send(ros_string("down"))
        assert (await anext(aiter(subscriber))).data == "down"
        answer = await node.service_client("/ask", EMPTY)(data=True)
        assert (answer.success, answer.message) == (True, "cloud")
        assert await engine.end("serve").port.call(b"\x01") == b"\x00" + ros_string("got True")


@pytest.mark.parametrize("kind", ["ours", pytest.param("roscore", marks=pytest.mark.needs("roslaunch"))])
async def test_a_restarted_master_is_told_everything_again(kind: str, engine: Engine, tmp_path: Path) -> None:
    async def cloud_answers(_: bytes) -> bytes:
        return b"\x01" + ros_string("cloud")

    port = free_port()
    path = write(tmp_path, config(engine.door.url))
    async with program(path, master=f"http://127.0.0.1:{port}/") as bridge:
        async with GRAPHS[kind](tmp_path, port) as graph:
            await bridge.until("rce-ros ready")
            engine.end("ask").answer = cloud_answers
            await everything_flows(graph, engine)
        async with GRAPHS[kind](tmp_path, port) as graph:
            await everything_flows(graph, engine)
        assert bridge.process.returncode is None
        assert not any("Traceback" in line for line in bridge.lines)


async def test_uplink_subscribes_once_its_master_is_back(
    engine: Engine, caplog: pytest.LogCaptureFixture
) -> None:
    """The master restarts while a topic is asked for: the demand does not change any more."""
    port = free_port()
    span = Span("say", Role.SUBSCRIBER, STRING, "/say", on_demand=True)
    async with engine.connection() as conn, contextlib.AsyncExitStack() as stack:
        publisher = await conn.publisher("say", STRING, raw=True)
        await publisher.wait_active(60)
        async with Core(host="127.0.0.1", port=port) as core:
            node = await stack.enter_async_context(
                Node("bridge", argv=(), master_uri=core.uri, signals=False)
            )
        tasks = await stack.enter_async_context(TaskScope())
        tasks.spawn(Uplink(conn, publisher).listen_on_demand(node, span), name="uplink")
        async with asyncio.timeout(60):
            while "/say cannot be subscribed to" not in caplog.text:
                await asyncio.sleep(0.01)
        async with (
            Core(host="127.0.0.1", port=port) as core,
            Node("robot", argv=(), master_uri=core.uri, signals=False) as robot,
        ):
            sayer = await robot.advertise("/say", STRING)
            await sayer.wait_for_subscribers(1, timeout=60)
            sayer.publish(data="up")
            async with asyncio.timeout(60):
                assert await engine.end("say").received.get() == ros_string("up")
            await stack.aclose()


async def test_a_master_that_goes_away_while_the_bridge_starts_is_waited_for(
    engine: Engine, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    spans = [
        Span("say", Role.SUBSCRIBER, STRING, "/say"),
        Span("hear", Role.PUBLISHER, STRING, "/hear"),
        Span("ask", Role.SERVICE_PROVIDER, EMPTY, "/ask"),
    ]
    async with engine.connection() as conn, contextlib.AsyncExitStack() as stack:
        async with Core(host="127.0.0.1", port=port) as core:
            node = Node("bridge", argv=(), master_uri=core.uri, signals=False, master_timeout=0.2)
            await stack.enter_async_context(node)
        tasks = await stack.enter_async_context(TaskScope())
        async with asyncio.timeout(60), asyncio.TaskGroup() as laid:
            for span in spans:
                laid.create_task(lay(span, conn, node, tasks))
            while caplog.text.count("waiting for the robot's ROS master") < len(spans):
                await asyncio.sleep(0.01)
            core = await stack.enter_async_context(Core(host="127.0.0.1", port=port))
        robot = await stack.enter_async_context(Node("robot", argv=(), master_uri=core.uri, signals=False))
        await (await robot.advertise("/say", STRING)).wait_for_subscribers(1, timeout=60)
        await (await robot.subscribe("/hear", STRING)).wait_for_publishers(1, timeout=60)
        await robot.wait_for_service("/ask", timeout=60)
